#!/usr/bin/env python3
"""Decodes what a batch run wrote: the message blocks of one MCU as text, one message a line.

klippy/klippy.py printer.cfg -i part.gcode -o OUT -d DICT
klippy/parsedump.py DICT OUT
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgproto

READ_BYTES = 1 << 16


def decode(parser: msgproto.MessageParser, path: Path) -> Iterator[str]:
    """Text of each message in a file of blocks; bytes that belong to no block are reported where they are."""
    reader = msgproto.BlockReader()
    with path.open("rb") as handle:
        while data := handle.read(READ_BYTES):
            for block in reader.feed(data):
                if block is None:
                    yield f"# bytes that are no block ({reader.invalid_bytes} so far)"
                    continue
                try:
                    yield from map(parser.format_params, parser.parse_content(block.content))
                except msgproto.error as e:
                    yield f"# {block.content.hex()}: {e}"
    if reader.pending:
        yield f"# {reader.pending} bytes of an unfinished block at the end"


def main(argv: Sequence[str]) -> int:
    """Exit status 0 decoded, 2 bad input."""
    if len(argv) != 2:
        print(__doc__, file=sys.stderr)
        return 2
    parser = msgproto.MessageParser()
    try:
        parser.process_identify(Path(argv[0]).read_bytes(), decompress=False)
        for line in decode(parser, Path(argv[1])):
            print(line)
    except (OSError, msgproto.error) as e:
        print(f"parsedump: {e}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except BrokenPipeError:
        sys.exit(0)
