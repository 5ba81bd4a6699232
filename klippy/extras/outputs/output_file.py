"""Files that commands write: in one folder, each under a name that is free.

A printed file may name them. A name must not lead out of the folder, and whatever is there already stays as it is:
a config, a log, a device, a pipe that nobody reads.

    calibration_folder, or where the log is
      ├── dump.csv         there already
      └── dump-2.csv       what FILE=dump.csv writes
"""

from __future__ import annotations

from itertools import count
from pathlib import Path
from typing import BinaryIO, TextIO

from roles import Printer


class OutputError(Exception):
    """The file cannot be written; the text is for people."""


def default_folder(printer: Printer) -> str:
    """Beside the log, so that front ends offer both; a program without a log says where else (`output_folder`)."""
    args = printer.get_start_args()
    log_file = args.get("log_file")
    return str(Path(log_file).parent) if log_file else args.get("output_folder") or "~/printer_data/logs"


def open_new(folder: Path, name: str) -> TextIO:
    """A new file for text, `name` in `folder` or below; a number goes to a name that is taken. Raises OutputError.

    The stream's own `name` is the path. Missing folders are made.
    """
    try:
        top = folder.resolve()
        path = (top / Path(name).expanduser()).resolve()  # an absolute name and a link lead where they lead
        if path == top or not path.is_relative_to(top):
            raise OutputError(f"'{name}' is not in {folder}; give a name without a path, such as dump.csv")
        path.parent.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            free = path if number == 1 else path.with_stem(f"{path.stem}-{number}")
            try:
                return free.open("x", newline="", encoding="utf-8")
            except FileExistsError:
                if not free.is_file():
                    raise OutputError(
                        f"'{name}' is a folder, a pipe or a device; give another name"
                    ) from None
    except OSError as e:
        raise OutputError(f"'{name}' cannot be written in {folder}: {e.strerror}") from None
    except (RuntimeError, ValueError) as e:  # no such user's home, a loop of links, a zero byte
        raise OutputError(f"'{name}' is no name of a file: {e}") from None
    raise AssertionError  # count() has no end


def open_new_binary(folder: Path, name: str) -> BinaryIO:
    """The same for bytes. Raises OutputError."""
    stream = open_new(folder, name)
    stream.close()
    return open(stream.name, "wb")  # the caller closes it
