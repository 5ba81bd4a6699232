"""The wire protocol as pure functions and tables: bytes in, messages out. No port, no thread, no clock.

From the outside in:

- *block*: ``len seq content… crc_hi crc_lo 0x7e`` (`encode_block`, `check_block`, `BlockReader`)
- *content*: messages one after the other (`MessageParser.parse_content`)
- *message*: VLQ id, then its parameters in the order of its format (`MessageFormat`)
- *dictionary*: which id has which format, with the names of pins and constants (`MessageParser.process_identify`)

Formats look like ``queue_step oid=%c interval=%u count=%hu add=%hi``. Integers are VLQ whatever their declared
width; ``%s %*s %.*s`` are a length byte and raw bytes. Only ``identify`` and ``identify_response`` have ids known
before the dictionary has been read. The reference for every byte here is Klipper's documentation page Protocol.md.
"""

from __future__ import annotations

import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import chelper

BLOCK_MIN, BLOCK_MAX = 5, 64
BLOCK_HEAD, BLOCK_TAIL = 2, 3
CONTENT_MAX = BLOCK_MAX - BLOCK_HEAD - BLOCK_TAIL
NUMBER_MAX = 5  # bytes of a number
BLOCK_SYNC = 0x7E
BLOCK_DEST, BLOCK_SEQ_MASK = 0x10, 0x0F

IDENTIFY_COMMAND = "identify offset=%u count=%c"
IDENTIFY_RESPONSE = "identify_response offset=%u data=%.*s"
IDENTIFY_IDS = {IDENTIFY_COMMAND: 1, IDENTIFY_RESPONSE: 0}

DICTIONARY_MAX = 1 << 22  # bytes; real ones have some 20,000
ENUMERATION_MAX = 1 << 16  # names in one range

Params = dict[str, Any]


class error(Exception):
    """A message, block or dictionary that cannot be; the text is for people."""


class enumeration_error(error):
    """A text that is no value of a parameter's enumeration (a pin name, mostly)."""

    def __init__(self, param: str, text: str) -> None:
        super().__init__(f"'{text}' is not a known value of parameter '{param}'")
        self.param, self.text = param, text


# --- integers ---------------------------------------------------------------------------------------------------


_SHORT = [bytes((number,)) for number in range(0x80)]


def encode_vlq(value: int) -> bytes:
    """Big-endian groups of 7 bits, 0x80 = more follow. n groups hold -2**(7n-2) .. 3*2**(7n-2)-1, five all."""
    if -32 <= value < 96:
        return _SHORT[value & 0x7F]
    if not -(1 << 26) <= value < 3 << 26:  # a clock, mostly
        high = (value >> 28 & 0x7F | 0x80, value >> 21 & 0x7F | 0x80, value >> 14 & 0x7F | 0x80)
        return bytes((*high, value >> 7 & 0x7F | 0x80, value & 0x7F))
    groups = [value & 0x7F]
    reach = 1 << 5
    while not -reach <= value < 3 * reach:
        reach <<= 7
        groups.append(value >> 7 * len(groups) & 0x7F | 0x80)
    return bytes(reversed(groups))


def decode_vlq(data: Sequence[int], pos: int) -> tuple[int, int]:
    """(signed value, position after it). A first group of 0x60..0x7f is negative. Raises `error` when cut short."""
    try:
        byte = data[pos]
        value = byte & 0x7F
        if value >= 0x60:
            value -= 0x80
        while byte & 0x80:
            pos += 1
            byte = data[pos]
            value = value << 7 | byte & 0x7F
    except IndexError:
        raise error("message ends in the middle of a number") from None
    return value, pos + 1


# --- blocks -----------------------------------------------------------------------------------------------------

# One entry for each value of the low byte of (crc ^ data): the reflected polynomial 0x8408 applied eight times.
_CRC_TABLE: list[int] = []
for _byte in range(256):
    _crc = _byte
    for _ in range(8):
        _crc = _crc >> 1 ^ (0x8408 if _crc & 1 else 0)
    _CRC_TABLE.append(_crc)


def crc16(data: bytes | bytearray | memoryview) -> int:
    """CRC-16/MCRF4XX: starts at 0xffff, reflected, no final xor; b"123456789" gives 0x6f91."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


def encode_block(seq: int, content: bytes) -> bytes:
    """Frame up to 59 bytes of messages (none: an ack)."""
    if len(content) > CONTENT_MAX:
        raise error(f"{len(content)} bytes do not fit into one block of {BLOCK_MAX} bytes")
    head = bytes((len(content) + BLOCK_HEAD + BLOCK_TAIL, BLOCK_DEST | seq & BLOCK_SEQ_MASK)) + content
    return head + crc16(head).to_bytes(2, "big") + bytes((BLOCK_SYNC,))


def check_block(data: bytes | bytearray | memoryview) -> int:
    """What `data` begins with: n > 0 a valid block of n bytes, 0 too few to decide, -n no block: drop n bytes."""
    if not len(data):
        return 0
    if data[0] == BLOCK_SYNC:
        return -1
    length = data[0]
    may_be_head = BLOCK_MIN <= length <= BLOCK_MAX and (
        len(data) < 2 or data[1] & ~BLOCK_SEQ_MASK == BLOCK_DEST
    )
    if may_be_head:
        if len(data) < length:
            return 0
        expected = data[length - 3] << 8 | data[length - 2]
        if data[length - 1] == BLOCK_SYNC and crc16(data[: length - BLOCK_TAIL]) == expected:
            return length
    sync = bytes(data).find(BLOCK_SYNC)
    return -(sync + 1) if sync >= 0 else -len(data)


@dataclass(frozen=True, slots=True)
class Block:
    """One valid block: its 4-bit sequence and its content."""

    seq: int
    content: bytes


class BlockReader:
    """Finds the blocks in a byte stream that may be cut anywhere and may contain garbage."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.invalid_bytes = 0

    @property
    def pending(self) -> int:
        """Bytes of a block that is not complete yet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> Iterator[Block | None]:
        """Blocks completed by `data`; None stands for a run of bytes that was no block."""
        self._buffer += data
        while verdict := check_block(self._buffer):
            if verdict > 0:
                content = bytes(self._buffer[BLOCK_HEAD : verdict - BLOCK_TAIL])
                yield Block(self._buffer[1] & BLOCK_SEQ_MASK, content)
            elif self._buffer[0] != BLOCK_SYNC:
                self.invalid_bytes -= verdict
                yield None
            del self._buffer[: abs(verdict)]


# --- parameters -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ParamType:
    """How one %-code behaves. Values of 32-bit types wrap as the MCU's registers do; narrower ones must fit."""

    code: str
    letter: str  # that chelper/link/message.h encodes it by
    is_buffer: bool = False
    signed: bool = False
    low: int = 0
    high: int = 0  # equal to low: any value, taken modulo 2**32


PARAM_TYPES = {
    t.code: t
    for t in (
        ParamType("%c", "c", low=-128, high=255),
        ParamType("%hu", "H", low=0, high=65535),
        ParamType("%hi", "h", signed=True, low=-32768, high=32767),
        ParamType("%u", "u"),
        ParamType("%i", "i", signed=True),
        ParamType("%s", "s", is_buffer=True),
        ParamType("%*s", "s", is_buffer=True),
        ParamType("%.*s", "s", is_buffer=True),
    )
}


@dataclass(frozen=True, slots=True)
class Param:
    """One parameter of a format, with the names of its values if its enumeration has any."""

    name: str
    type: ParamType
    by_text: Mapping[str, int] = field(default_factory=dict)
    by_value: Mapping[int, str] = field(default_factory=dict)

    def encode(self, value: Any) -> bytes:
        kind = self.type
        if kind.is_buffer:
            data = bytes(value)
            if len(data) > CONTENT_MAX:
                raise error(f"parameter '{self.name}' of {len(data)} bytes is too long for a message")
            return bytes((len(data),)) + data
        if type(value) is not int:
            value = int(self._value_of(value) if isinstance(value, str) else value)
        if kind.low == kind.high:
            value &= 0xFFFFFFFF
            if kind.signed and value >= 1 << 31:
                value -= 1 << 32
        elif not kind.low <= value <= kind.high:
            raise error(f"parameter '{self.name}' is {value}; it must be from {kind.low} to {kind.high}")
        return encode_vlq(value)

    def _value_of(self, text: str) -> int:
        value = self.by_text.get(text)
        if value is None:
            raise enumeration_error(self.name, text)
        return value

    @property
    def kind(self) -> str:
        """The letter that chelper/link/message.h decodes it by."""
        return "s" if self.type.is_buffer else "i" if self.type.signed else "u"

    def from_text(self, text: str) -> Any:
        """The value written in a command line: a number (any base), an enumeration's name, or hex bytes."""
        if self.type.is_buffer:
            try:
                return bytes.fromhex(text)
            except ValueError:
                raise error(f"parameter '{self.name}={text}' must be hexadecimal bytes") from None
        if text in self.by_text:
            return self.by_text[text]
        try:
            return int(text, 0)
        except ValueError:
            pass
        return self._value_of(text)

    def to_text(self, value: Any) -> str:
        return value.hex() if isinstance(value, bytes) else str(value)


_FORMAT_WORD = re.compile(r"(\w+)=(%\S+)")


@cache
def _decoder() -> tuple[Any, Any]:
    """The C helper's decoder, and room for the numbers of one message."""
    ffi, lib = chelper.get_ffi()
    return lib.message_decode, ffi.new("int64_t[]", CONTENT_MAX)


@cache
def _encoder() -> tuple[Any, Any, Any, Any]:
    """The C helper's encoder, room for the numbers of one message and for their bytes, as memory and as a buffer."""
    ffi, lib = chelper.get_ffi()
    out = ffi.new("uint8_t[]", CONTENT_MAX * NUMBER_MAX)
    return lib.message_encode, ffi.new("int64_t[]", CONTENT_MAX), out, ffi.buffer(out)


@dataclass(frozen=True, slots=True)
class MessageFormat:
    """One message of the dictionary: encodes from values, decodes to a dict."""

    msgid: int
    msgformat: str
    name: str
    params: tuple[Param, ...]
    id_bytes: bytes
    names: tuple[str, ...]  # of the parameters ...
    kinds: bytes  # ... and their letters
    leading: bytes  # letters of the numbers before the first buffer, to encode them by
    buffers: tuple[tuple[int, str], ...]  # place and name of those that are no numbers
    enumerated: tuple[tuple[int, str, Mapping[int, str]], ...]  # and of those that stand for a name

    @classmethod
    def _of(cls, msgid: int, msgformat: str, name: str, params: tuple[Param, ...]) -> MessageFormat:
        if len(params) > CONTENT_MAX:
            raise error(
                f"the dictionary's message '{name}' has {len(params)} parameters; no block takes so many"
            )
        return cls(
            msgid,
            msgformat,
            name,
            params,
            encode_vlq(msgid),
            tuple(p.name for p in params),
            "".join(p.kind for p in params).encode(),
            "".join(p.type.letter for p in params).partition("s")[0].encode(),
            tuple((n, p.name) for n, p in enumerate(params) if p.type.is_buffer),
            tuple((n, p.name, p.by_value) for n, p in enumerate(params) if p.by_value and p.kind != "s"),
        )

    @classmethod
    def build(
        cls, msgid: int, msgformat: str, enumerations: Mapping[str, Mapping[str, int]]
    ) -> MessageFormat:
        """Read a format text. Raises `error` if it has a word that is no ``name=%code``."""
        words = msgformat.split()
        if not words:
            raise error("the dictionary has a message without a name")
        params = tuple(_build_param(word, msgformat, enumerations) for word in words[1:])
        return cls._of(msgid, msgformat, words[0], params)

    @classmethod
    def build_output(cls, msgid: int, text: str) -> MessageFormat:
        """A debugging text of the firmware: any words, with %-codes among them."""
        codes = re.findall(r"%(?:\.?\*)?(?:h?[uic]|s)", text)
        params = tuple(
            Param(f"value{n}", PARAM_TYPES[code]) for n, code in enumerate(codes) if code in PARAM_TYPES
        )
        return cls._of(msgid, text, "#output", params)

    def encode(self, values: Sequence[Any]) -> bytes:
        """The message with its parameters in order. Enumerated ones may be given by name."""
        if len(values) != len(self.params):
            raise error(f"'{self.msgformat}' takes {len(self.params)} parameters, not {len(values)}")
        encode, numbers, out, written = _encoder()
        count, message = len(self.leading), self.id_bytes
        try:
            numbers[0:count] = values if count == len(values) else values[:count]
            size = encode(self.leading, numbers, out)
        except (TypeError, OverflowError):  # a name, or a number of another kind
            size = -1
        if size >= 0:
            message += written[:size]
        else:
            count = 0
        if count < len(values):
            message += self._encode_each(values, count)
        if len(message) > CONTENT_MAX:
            raise error(f"command '{self.name}' has {len(message)} bytes; a block takes {CONTENT_MAX}")
        return message

    def _encode_each(self, values: Sequence[Any], start: int) -> bytes:
        try:
            return b"".join([p.encode(v) for p, v in zip(self.params[start:], values[start:], strict=True)])
        except (error, TypeError, ValueError) as e:
            raise error(f"command '{self.name}': {e}") from None

    def encode_named(self, values: Mapping[str, Any]) -> bytes:
        """Like `encode`, by parameter name."""
        missing = [p.name for p in self.params if p.name not in values]
        extra = sorted(set(values) - {p.name for p in self.params})
        if missing or extra:
            complaint = f"lacks {', '.join(missing)}" if missing else f"does not know {', '.join(extra)}"
            raise error(f"command '{self.name}' {complaint} (its format is '{self.msgformat}')")
        return self.encode([values[p.name] for p in self.params])

    def decode(self, data: bytes, pos: int) -> tuple[Params, int]:
        """Parameters that follow the id at `pos`, and the position after them."""
        decode, found = _decoder()
        pos = decode(data, len(data), pos, self.kinds, found)
        if pos < 0:
            cut = -2 - pos
            where = "in the middle of a number" if cut < 0 else f"inside parameter '{self.names[cut]}'"
            raise error(f"message ends {where}")
        values: Params = dict(zip(self.names, found, strict=False))
        for n, name in self.buffers:
            start = found[n] >> 8
            values[name] = data[start : start + (found[n] & 0xFF)]
        for n, name, by_value in self.enumerated:
            values[name] = by_value.get(found[n], f"?{found[n]}")
        values["#name"] = self.name
        return values, pos

    def zeros(self) -> Params:
        """Every field 0 or empty: the dummy answer of a run without an MCU."""
        values: Params = {p.name: b"" if p.type.is_buffer else 0 for p in self.params}
        values["#name"] = self.name
        return values

    def format_params(self, values: Mapping[str, Any]) -> str:
        """``name a=1 b=2``: the text that `MessageParser.create_command` reads."""
        return " ".join([self.name, *(f"{p.name}={p.to_text(values[p.name])}" for p in self.params)])


def _build_param(word: str, msgformat: str, enumerations: Mapping[str, Mapping[str, int]]) -> Param:
    match = _FORMAT_WORD.fullmatch(word)
    kind = PARAM_TYPES.get(match[2]) if match else None
    if match is None or kind is None:
        raise error(f"the dictionary's message '{msgformat}' has a parameter '{word}' of no known kind")
    name = match[1]
    by_text = _enumeration_for(name, enumerations)
    return Param(name, kind, by_text, {value: text for text, value in by_text.items()})


def _enumeration_for(param: str, enumerations: Mapping[str, Mapping[str, int]]) -> Mapping[str, int]:
    """The enumeration of this name, else the longest one that is a suffix after ``_``."""
    if param in enumerations:
        return enumerations[param]
    suffixes = [name for name in enumerations if param.endswith("_" + name)]
    return enumerations[max(suffixes, key=len)] if suffixes else {}


def _expand_enumeration(entries: Mapping[str, Any]) -> dict[str, int]:
    """Dictionary form to plain names: ``"PA0": [0, 16]`` stands for PA0=0 … PA15=15."""
    out: dict[str, int] = {}
    for text, value in entries.items():
        if isinstance(value, int):
            out[text] = value
            continue
        start, count = value
        if not 0 <= count <= ENUMERATION_MAX:
            raise error(f"the enumeration of '{text}' has {count} values")
        root = text.rstrip("0123456789")
        first = int(text[len(root) :] or 0)
        out.update({f"{root}{first + i}": start + i for i in range(count)})
    return out


# --- the dictionary ---------------------------------------------------------------------------------------------


class MessageParser:
    """All messages and commands of one firmware. Knows only ``identify`` until `process_identify` was called."""

    error = error

    def __init__(self, warn_prefix: str = "") -> None:
        self.warn_prefix = warn_prefix
        self.version = self.build_versions = self.app = self.license = ""
        self.raw_identify_data = b""
        self._config: dict[str, Any] = {}
        self._enumerations: dict[str, dict[str, int]] = {}
        self._commands: dict[str, MessageFormat] = {}
        self._responses: dict[str, MessageFormat] = {}
        self._by_id: dict[int, MessageFormat] = {}
        self._tags: list[tuple[int, str, str]] = []
        self._add("command", IDENTIFY_COMMAND, IDENTIFY_IDS[IDENTIFY_COMMAND])
        self._add("response", IDENTIFY_RESPONSE, IDENTIFY_IDS[IDENTIFY_RESPONSE])

    def _add(self, kind: str, msgformat: str, msgid: int) -> None:
        if kind == "output":
            self._by_id[msgid] = MessageFormat.build_output(msgid, msgformat)
            self._tags.append((msgid, kind, msgformat))
            return
        message = MessageFormat.build(msgid, msgformat, self._enumerations)
        table = self._commands if kind == "command" else self._responses
        table[message.name] = message
        self._by_id[msgid] = message
        self._tags.append((msgid, kind, msgformat))

    def process_identify(self, data: bytes, decompress: bool = True) -> None:
        """Take the dictionary as fetched from an MCU (compressed) or read from a file. Raises `error`."""
        try:
            raw = zlib.decompressobj().decompress(data, DICTIONARY_MAX) if decompress else bytes(data)
            tables = json.loads(raw)
            self._load(tables)
        except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError) as e:
            raise error(
                f"{self.warn_prefix}The data dictionary of the firmware can not be read: {e}"
            ) from None
        self.raw_identify_data = raw

    def _load(self, tables: dict[str, Any]) -> None:
        self._enumerations = {k: _expand_enumeration(v) for k, v in tables.get("enumerations", {}).items()}
        self._commands, self._responses, self._by_id, self._tags = {}, {}, {}, []
        for kind, key in (("command", "commands"), ("response", "responses"), ("output", "output")):
            for msgformat, msgid in tables.get(key, {}).items():
                self._add(kind, msgformat, int(msgid))
        self._config = dict(tables.get("config", {}))
        self.version = str(tables.get("version", ""))
        self.build_versions = str(tables.get("build_versions", ""))
        self.app = str(tables.get("app", ""))
        self.license = str(tables.get("license", ""))

    # decoding

    def parse_message(self, data: bytes, pos: int = 0) -> tuple[Params, int]:
        """The message at `pos` as {parameter: value, "#name": …} and the position after it. Raises `error`."""
        msgid, after = (data[0], 1) if not pos and data and data[0] < 0x60 else decode_vlq(data, pos)
        message = self._by_id.get(msgid)
        if message is None:
            raise error(f"{self.warn_prefix}message id {msgid} is not in the dictionary")
        return message.decode(data, after)

    def parse_content(self, content: bytes) -> list[Params]:
        """All messages of one block's content. Raises `error`."""
        out = []
        pos = 0
        while pos < len(content):
            params, pos = self.parse_message(content, pos)
            out.append(params)
        return out

    def parse(self, content: bytes) -> Params:
        """The one message that an MCU's block holds. Raises `error` if there is anything else in it."""
        params, pos = self.parse_message(bytes(content))
        if pos != len(content):
            raise error(
                f"{self.warn_prefix}message '{params['#name']}' is followed by {len(content) - pos} extra bytes"
            )
        return params

    def format_params(self, params: Mapping[str, Any]) -> str:
        """Text of a decoded message, for logs and dumps."""
        name = str(params.get("#name"))
        message = self._responses.get(name) or self._commands.get(name)
        return message.format_params(params) if message is not None else str(dict(params))

    # encoding

    def lookup_command(self, msgformat: str) -> MessageFormat:
        """The message with exactly this format. Raises `error` if this firmware has none, or another by this name."""
        words = msgformat.split()
        name = words[0] if words else ""
        message = self._commands.get(name) or self._responses.get(name)
        if message is None:
            raise error(f"Unknown command: {name}")
        if message.msgformat != msgformat:
            raise error(
                f"Command format mismatch: the host uses '{msgformat}', the firmware '{message.msgformat}'"
            )
        return message

    def lookup_response(self, name: str) -> MessageFormat | None:
        """A response by name alone; None if the firmware never sends it."""
        return self._responses.get(name)

    def lookup_msgid(self, msgformat: str) -> int:
        return self.lookup_command(msgformat).msgid

    def create_command(self, text: str) -> bytes:
        """Encode a command written as ``name a=1 pin=PA3 data=00ff``. Raises `error`."""
        words = text.split()
        message = self._commands.get(words[0]) if words else None
        if message is None:
            raise error(f"Unknown command: {words[0] if words else '(empty)'}")
        params = {p.name: p for p in message.params}
        values: Params = {}
        for word in words[1:]:
            name, equals, value = word.partition("=")
            if not equals:
                raise error(f"command '{text}': '{word}' is not of the form name=value")
            if name not in params:
                raise error(
                    f"command '{text}' has an unknown parameter '{name}' (its format is '{message.msgformat}')"
                )
            try:
                values[name] = params[name].from_text(value)
            except enumeration_error:
                raise
            except error as e:
                raise error(f"command '{text}': {e}") from None
        return message.encode_named(values)

    # facts

    def get_messages(self) -> list[tuple[int, str, str]]:
        """(id, "command" | "response" | "output", format) of every message."""
        return list(self._tags)

    def get_enumerations(self) -> dict[str, dict[str, int]]:
        return {name: dict(entries) for name, entries in self._enumerations.items()}

    def get_constants(self) -> dict[str, Any]:
        return dict(self._config)

    def get_constant(self, name: str, default: Any = ..., parser: type = str) -> Any:
        """A constant of the firmware. Raises `error` if it has none and no default is given."""
        if name not in self._config:
            if default is ...:
                raise error(f"{self.warn_prefix}the firmware has no constant '{name}'")
            return default
        try:
            return parser(self._config[name])
        except (TypeError, ValueError):
            text = f"the firmware's constant '{name}' is '{self._config[name]}', not a {parser.__name__}"
            raise error(self.warn_prefix + text) from None

    def get_constant_float(self, name: str, default: Any = ...) -> float:
        return self.get_constant(name, default, parser=float)

    def get_constant_int(self, name: str, default: Any = ...) -> int:
        return self.get_constant(name, default, parser=int)

    def get_version_info(self) -> tuple[str, str]:
        return self.version, self.build_versions

    def get_raw_data_dictionary(self) -> bytes:
        return self.raw_identify_data
