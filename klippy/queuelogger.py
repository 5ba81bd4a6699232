"""The host's log: records are queued and written by a thread of their own: a slow disk does not delay the host."""

from __future__ import annotations

import logging
import logging.handlers
import queue
import time

_KEEP_FILES = 5
_UNMARKED_LEVELS = (logging.INFO, logging.DEBUG)


class LineFormatter(logging.Formatter):
    """The bare message; warnings and errors are marked."""

    def format(self, record: logging.LogRecord) -> str:
        text = super().format(record)
        return text if record.levelno in _UNMARKED_LEVELS else f"{record.levelname.lower()}: {text}"


class RolloverFile(logging.handlers.TimedRotatingFileHandler):
    """A log file per day; each new one starts with what is needed to understand it (config, versions)."""

    def __init__(self, path: str) -> None:
        super().__init__(path, when="midnight", backupCount=_KEEP_FILES, encoding="utf-8")
        self.setFormatter(LineFormatter("%(message)s"))
        self.rollover_info: dict[str, str] = {}

    def doRollover(self) -> None:
        """Start the next file."""
        super().doRollover()
        lines = [text for _, text in sorted(self.rollover_info.items())]
        lines.append(f"=============== Log rollover at {time.asctime()} ===============")
        self.emit(logging.makeLogRecord({"msg": "\n".join(lines), "levelno": logging.INFO}))


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
