"""The host's log: records are queued and written by a thread of their own: a slow disk does not delay the host."""

from __future__ import annotations

import glob
import io
import logging
import logging.handlers
import os
import queue
import sys
import time

_KEEP_FILES = 5
_SIZE_MAX = 100_000_000  # bytes; a print of a day writes about 60 MB
_MODE = 0o640  # G-code, file names and the config are not for everybody on this computer
_UNMARKED_LEVELS = (logging.INFO, logging.DEBUG)


class LineFormatter(logging.Formatter):
    """The bare message; warnings and errors are marked."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno in _UNMARKED_LEVELS else f"{record.levelname.lower()}: {text}"


class RolloverFile(logging.handlers.TimedRotatingFileHandler):
    """A log file per day, and another when it is too long.

    Each new one starts with what is needed to understand it (config, versions). A full disk is reported once on
    stderr; what is logged meanwhile is lost.
    """

    def __init__(self, path: str, size_max: int = _SIZE_MAX) -> None:
        self._size_max = size_max
        self._problem: BaseException | None = None  # of the last record
        super().__init__(path, when="midnight", backupCount=_KEEP_FILES, encoding="utf-8")
        self.setFormatter(LineFormatter("%(message)s"))
        self.rollover_info: dict[str, str] = {}

    def _open(self) -> io.TextIOWrapper:
        return open(
            self.baseFilename, "a", encoding="utf-8", opener=lambda path, how: os.open(path, how, _MODE)
        )

    def shouldRollover(self, record: logging.LogRecord) -> bool:
        """Whether the record belongs into the next file."""
        too_long = self.stream is not None and os.fstat(self.stream.fileno()).st_size >= self._size_max
        return too_long or bool(super().shouldRollover(record))

    def rotation_filename(self, default_name: str) -> str:
        """A name that is free: more than one file may end on a day."""
        name, number = default_name, 2
        while os.path.exists(name):
            name, number = f"{default_name}.{number}", number + 1
        return name

    def getFilesToDelete(self) -> list[str]:
        """All old files but the last ones."""
        old = sorted(glob.glob(f"{glob.escape(self.baseFilename)}.2*"), key=os.path.getmtime)
        return old[:-_KEEP_FILES]

    def doRollover(self) -> None:
        """Start the next file."""
        super().doRollover()
        lines = [text for _, text in sorted(self.rollover_info.items())]
        lines.append(f"=============== Log rollover at {time.asctime()} ===============")
        text = "\n".join(lines)
        logging.StreamHandler.emit(self, logging.makeLogRecord({"msg": text, "levelno": logging.INFO}))

    def emit(self, record: logging.LogRecord) -> None:
        """Write a record."""
        reported, self._problem = self._problem, None
        super().emit(record)
        if self._problem is not None and reported is None:
            print(f"The log {self.baseFilename} cannot be written: {self._problem}", file=sys.stderr)

    def handleError(self, record: logging.LogRecord) -> None:
        """A record could not be written."""
        self._problem = sys.exc_info()[1]


class QueueListener:
    """Feeds a log file from a queue until `stop`."""

    def __init__(self, path: str) -> None:
        self._file = RolloverFile(path)
        records: queue.SimpleQueue[logging.LogRecord] = queue.SimpleQueue()
        self.handler = logging.handlers.QueueHandler(records)
        self._listener = logging.handlers.QueueListener(records, self._file)
        self._listener.start()
        logging.getLogger().addHandler(self.handler)

    def set_rollover_info(self, name: str, info: str) -> None:
        """Text to repeat at the top of each new file."""
        self._file.rollover_info[name] = info

    def clear_rollover_info(self) -> None:
        """Forget those texts (at a restart)."""
        self._file.rollover_info.clear()

    def stop(self) -> None:
        """Write out what is queued and close the file."""
        logging.getLogger().removeHandler(self.handler)
        self._listener.stop()
        self._file.close()


def setup_bg_logging(filename: str) -> QueueListener:
    """Log to a file from now on."""
    return QueueListener(filename)
