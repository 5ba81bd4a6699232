"""Studies: many simulated prints of one study file, in parallel, and one table of their figures.

    STUDY.toml ─► studyfile ─► sampling ─► job ─► engine ══ dask ══► worker: job.execute ─► child, one process a print
                                                    │
                 page.html, results.parquet ◄─ results, analysis ◄─ journal.jsonl, one line a print

A print is known by the hash of everything that determines it (`Job.key`). The journal is the state of a study: a study
that starts again leaves out the prints whose keys it has.
"""
