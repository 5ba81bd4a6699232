#!/usr/bin/env python3
"""Serves a web front end (Mainsail, Fluidd, any folder with an index.html) beside Moonraker, on one address.

    klippy/webhooks/front_end.py ~/mainsail --port 80 --moonraker 7125

Files come from the folder. What front ends ask of Moonraker (/websocket, /printer/..., /server/..., and so on) is
passed on to it, so that the browser sees one server and no cross-origin rule applies. A name that is no file is
answered with index.html: front ends make their own addresses.
"""

from __future__ import annotations

import argparse
import asyncio
import mimetypes
import signal
import sys
import urllib.parse
from collections.abc import Sequence
from pathlib import Path

PASSED_ON = frozenset({"websocket", "printer", "server", "machine", "access", "api", "debug", "klippysocket"})
HEAD_MAX = 65536  # bytes of the head of a request
CHUNK = 65536
REFUSED = {400: "Bad Request", 404: "Not Found", 405: "Method Not Allowed", 502: "Bad Gateway"}


def find_file(folder: Path, target: str) -> Path | None:
    """The file of a request, or index.html for a name without a suffix; None if there is none in the folder."""
    path = urllib.parse.unquote(urllib.parse.urlsplit(target).path)
    if "\0" in path:
        return None
    found = (folder / path.lstrip("/")).resolve()
    if not found.is_relative_to(folder):
        return None
    if found.is_file():
        return found
    index = folder / "index.html"
    return index if not found.suffix and index.is_file() else None


async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """One direction of a connection that is passed on."""
    try:
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()
    except OSError:
        pass
    finally:
        writer.close()


class FrontEnd:
    """One folder and the Moonraker beside it."""

    def __init__(self, folder: Path, moonraker_port: int) -> None:
        self.folder = folder.resolve()
        self.moonraker_port = moonraker_port

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One connection: one file, or all that is passed on."""
        try:
            head = await reader.readuntil(b"\r\n\r\n")
            method, target, _ = head.split(b"\r\n", 1)[0].decode("latin-1").split(" ", 2)
            if urllib.parse.urlsplit(target).path.lstrip("/").split("/", 1)[0] in PASSED_ON:
                await self._pass_on(head, reader, writer)
            else:
                await self._send_file(method, target, writer)
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ValueError):
            refuse(writer, 400)
        except OSError:
            pass  # the browser has gone
        finally:
            writer.close()

    async def _pass_on(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            back_reader, back = await asyncio.open_connection("127.0.0.1", self.moonraker_port)
        except OSError:
            refuse(writer, 502)
            return
        # One request a connection: the next one may be for a file
        first, *lines = head[:-4].split(b"\r\n")
        names = [line.split(b":", 1)[0].strip().lower() for line in lines]
        if b"upgrade" not in names:
            lines = [line for line, name in zip(lines, names, strict=True) if name != b"connection"]
            lines.append(b"Connection: close")
        peer = writer.get_extra_info("peername")
        lines.append(b"X-Real-IP: " + str(peer[0] if peer else "").encode())
        back.write(b"\r\n".join([first, *lines]) + b"\r\n\r\n")
        await asyncio.gather(pump(reader, back), pump(back_reader, writer))

    async def _send_file(self, method: str, target: str, writer: asyncio.StreamWriter) -> None:
        if method not in ("GET", "HEAD"):
            refuse(writer, 405)
            return
        path = find_file(self.folder, target)
        if path is None:
            refuse(writer, 404)
            return
        kind = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
        size = path.stat().st_size
        writer.write(
            f"HTTP/1.1 200 OK\r\nContent-Type: {kind}\r\nContent-Length: {size}\r\n"
            "Cache-Control: no-cache\r\nConnection: close\r\n\r\n".encode()
        )
        if method == "GET":
            with path.open("rb") as stream:
                while data := stream.read(CHUNK):
                    writer.write(data)
                    await writer.drain()


def refuse(writer: asyncio.StreamWriter, status: int) -> None:
    """An answer without content."""
    text = f"HTTP/1.1 {status} {REFUSED[status]}\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
    writer.write(text.encode())


async def run(options: argparse.Namespace) -> None:
    """Serve until a signal."""
    front_end = FrontEnd(options.folder, options.moonraker)
    server = await asyncio.start_server(front_end.serve, options.host, options.port, limit=HEAD_MAX)
    print(f"front end: http://127.0.0.1:{options.port}/", flush=True)
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    await stop.wait()
    server.close()


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Serve a web front end beside Moonraker.")
    parser.add_argument("folder", type=Path, help="the unpacked release of a front end")
    parser.add_argument("--port", type=int, default=8080, help="port of the page (default 8080)")
    parser.add_argument("--host", default="", help="address to listen at (default: all)")
    parser.add_argument("--moonraker", type=int, default=7125, help="port of Moonraker (default 7125)")
    return parser.parse_args(argv)


def main(argv: Sequence[str]) -> int:
    options = parse(argv)
    if not (options.folder / "index.html").is_file():
        print(
            f"front_end: {options.folder} has no index.html: it is not the unpacked release of a web front end",
            file=sys.stderr,
        )
        return 2
    try:
        asyncio.run(run(options))
    except OSError as e:
        print(f"front_end: port {options.port} cannot be used: {e.strerror}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
