"""From raw coil samples to a temperature, and from a temperature target to bridge phases.

Pure: nothing in here opens a port, reads a clock or knows a printer; time is an argument everywhere.
The stages, each of which knows only the record it takes and the record it gives:

    bytes --convert--> SampleBlock --features--> Features --estimator--> TempEstimate
          --control--> PowerRequest --actuator--> PhaseCommand           (supervise watches all of them)

The first line runs in C, a message's blocks at a time (`chain`). `loop` strings the stages together for one
induction nozzle; `extras/induction_heater.py` connects it to a printer.
"""
