"""Decoder of raw Betaflight blackbox files (.bbl, .bfl): header and frames of every log in a file.

A frame that cannot be decoded is dropped, and so are all frames until the next one that needs no
predecessor (I). A file may end within a frame.

Source: Betaflight, "Blackbox logging internals"; frame checks as in Betaflight's
blackbox-log-viewer."""

import contextlib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from visthrow.common.errors import LogError
from visthrow.logs.readers.blackbox.codec import DECODERS, Corrupt, EndOfLog, Reader, extend, plan

MARKER = b"H Product:Blackbox flight data recorder by Nicholas Sherlock"
FRAMES = b"IPSGHE"
(
    ZERO,
    PREVIOUS,
    STRAIGHT_LINE,
    AVERAGE_2,
    MINTHROTTLE,
    MOTOR_0,
    INC,
    _,
    P1500,
    VBATREF,
    LAST_MAIN_TIME,
    MINMOTOR,
) = range(12)
"""Predictors. Those of GPS frames are missing, as these frames are skipped."""
_LONGEST_FRAME = 256  # bytes
_LONGEST_GAP_US = 10_000_000
_MOST_ITERATIONS = 5000 * 10
Frame = list[int]
"""Values of one frame, in the order of its fields."""
_EVENTS = {
    0: "sync beep",
    13: "adjustment",
    14: "logging resumes",
    15: "disarm",
    30: "flight mode",
    255: "end of log",
}


@dataclass
class Fields:
    """Definition of the fields of one kind of frame."""

    names: list[str] = field(default_factory=list)
    signed: list[int] = field(default_factory=list)
    predictor: list[int] = field(default_factory=list)
    encoding: list[int] = field(default_factory=list)


@dataclass
class BlackboxLog:
    """A decoded log, in the units of the file."""

    header: dict[str, str]
    names: list[str]  # of the columns of ``main``
    main: np.ndarray  # shape (T, fields), int64
    events: list[tuple[str, tuple[float, ...]]] = field(default_factory=list)
    frames: dict[str, int] = field(default_factory=dict)  # kind -> number decoded
    corrupt: int = 0  # number of byte ranges that could not be decoded
    dropped: int = 0  # frames that were decoded but depend on a damaged one
    complete: bool = False  # whether the log ends with its end marker


def read_blackbox(path: str | Path) -> list[BlackboxLog]:
    """Read every log of a raw file.

    Raises LogError: the file does not exist, is no blackbox file, or none of its logs has a frame.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read: {error.strerror or error}; expected a blackbox file"
        ) from error
    starts = []
    offset = data.find(MARKER)
    while offset >= 0:
        starts.append(offset)
        offset = data.find(MARKER, offset + 1)
    if not starts:
        raise LogError(
            f"{path}: no blackbox log in its {len(data)} bytes; expected '{MARKER.decode()}'"
        )
    logs = []
    problems = []
    for number, (start, end) in enumerate(zip(starts, [*starts[1:], len(data)]), start=1):
        try:
            logs.append(_Decoder(data[start:end]).decode())
        except LogError as error:
            problems.append(f"log {number}: {error}")
    logs = [log for log in logs if len(log.main)]
    if not logs:
        raise LogError(
            f"{path}: {len(starts)} log(s), none holds a frame {'; '.join(problems)}".rstrip()
        )
    return logs


class _Decoder:
    """A decoder of one log: header lines, then frames until the end."""

    def __init__(self, data: bytes):
        self.header: dict[str, str] = {}
        self.fields: dict[str, Fields] = {}
        self.reader = Reader(data, self._read_header(data))
        self._prepare()
        self.history: list[Frame] = []  # last frames, newest first; empty: not valid
        self.last_time = self.last_iteration = None

    def _read_header(self, data: bytes) -> int:
        pos = 0
        while data[pos : pos + 2] == b"H ":
            end = data.find(b"\n", pos)
            if end < 0:
                raise LogError("cut short within its header")
            key, colon, value = data[pos + 2 : end].decode("latin-1").partition(":")
            if colon:
                words = key.split()
                if len(words) == 3 and words[0] == "Field":
                    entry = self.fields.setdefault(words[1], Fields())
                    if words[2] == "name":
                        entry.names = value.split(",")
                    elif words[2] in ("signed", "predictor", "encoding"):
                        setattr(entry, words[2], _numbers(value, key))
                else:
                    self.header[key] = value.strip()
            pos = end + 1
        return pos

    def _prepare(self) -> None:
        header = self.header
        fields = self.fields
        if "I" not in fields or "P" not in fields:
            raise LogError("its header does not define I and P frames")
        names = fields["I"].names
        missing = {"time", "loopIteration"}.difference(names)
        if missing:
            raise LogError(f"its I frames have no field {' or '.join(sorted(missing))}")
        fields["P"].names = names
        fields["P"].signed = fields["I"].signed
        if header.get("Data version", "2") != "2":
            raise LogError(f"data version {header['Data version']}; expected version 2")
        for kind, definition in fields.items():
            sizes = {len(definition.names), len(definition.predictor), len(definition.encoding)}
            if len(sizes) > 1:
                raise LogError(
                    f"definition of {kind} frames contradicts itself: {sorted(sizes)} fields"
                )
            unknown = [code for code in definition.encoding if code not in DECODERS]
            if unknown:
                raise LogError(
                    f"{kind} frames use encoding {unknown[0]}; known:"
                    f" {', '.join(map(str, DECODERS))}"
                )
        self.plans = {
            kind: plan(definition.encoding, [p == INC for p in definition.predictor])
            for kind, definition in fields.items()
        }
        self.at_time = names.index("time")
        self.at_iteration = names.index("loopIteration")
        self.at_motor0 = names.index("motor[0]") if "motor[0]" in names else None
        output = _numbers(header.get("motorOutput", "0"), "motorOutput")
        self.constant = {
            MINTHROTTLE: _int(header, "minthrottle"),
            P1500: 1500,
            VBATREF: _int(header, "vbatref"),
            MINMOTOR: output[0],
        }
        self.interval = max(1, _int(header, "I interval", 32))
        num, _, denom = header.get("P interval", "1/1").partition("/")
        self.p_num, self.p_denom = (int(num), int(denom)) if denom else (1, max(1, int(num)))

    def decode(self) -> BlackboxLog:
        rows: list[Frame] = []
        log = BlackboxLog(self.header, self.fields["I"].names, np.empty((0, 0)))
        reader = self.reader
        lost = False
        while reader.pos < reader.end and not log.complete:
            start = reader.pos
            kind = chr(reader.data[reader.pos])
            try:
                frame = self._frame(kind, log)
            except EndOfLog:
                break
            except Corrupt:
                frame = None
            if frame is None:  # look for the next frame byte by byte
                log.corrupt += not lost
                lost = True
                self.history = []
                reader.pos = start + 1
                continue
            lost = False
            if kind != "E" and not frame:  # decoded, but depends on a lost frame
                log.dropped += 1
                continue
            log.frames[kind] = log.frames.get(kind, 0) + 1
            if kind in "IP":
                rows.append(frame)
        log.main = np.array(rows, dtype=np.int64).reshape(len(rows), len(log.names))
        return log

    def _frame(self, kind: str, log: BlackboxLog) -> Frame | None:
        """Return the values of the next frame; empty: not usable; None: no frame begins here."""
        reader = self.reader
        start = reader.pos
        reader.pos += 1
        if kind == "E":
            return self._note_event(log)
        if kind not in self.plans:
            return None
        base = self.history if kind == "P" else []
        values = self._values(kind, base)
        ended = reader.pos >= reader.end or reader.data[reader.pos] in FRAMES
        if not ended or reader.pos - start > _LONGEST_FRAME:
            return None
        if kind not in "IP":
            return values
        if (kind == "P" and not base) or not self._continuous(values, kind):
            self.history = []
            return []
        self.history = [values, values] if kind == "I" else [values, self.history[0]]
        self.last_time = values[self.at_time]
        self.last_iteration = values[self.at_iteration]
        return values

    def _note_event(self, log: BlackboxLog) -> Frame | None:
        """Add the next event to the log; return None if there is no event."""
        event = _event(self.reader)
        if event is None:
            return None
        log.events.append(event)
        log.complete = event[0] == "end of log"
        if event[0] == "logging resumes":
            self.last_iteration = int(event[1][0])
            self.last_time = int(event[1][1])
        return [1]

    def _values(self, kind: str, base: list[Frame]) -> Frame:
        definition = self.fields[kind]
        reader = self.reader
        values = [0] * len(definition.names)
        for decoder, first, count in self.plans[kind]:
            values[first : first + count] = decoder(reader, count)[:count]
        for i, predictor in enumerate(definition.predictor):
            if predictor == ZERO:
                continue
            values[i] = self._predict(predictor, i, values, base)
            unsigned = definition.signed and i < len(definition.signed) and not definition.signed[i]
            values[i] = values[i] & 0xFFFFFFFF if unsigned else extend(values[i], 32)
        return values

    def _predict(self, predictor: int, i: int, values: Frame, base: list[Frame]) -> int:
        value = values[i]
        if predictor in self.constant:
            return value + self.constant[predictor]
        if predictor == MOTOR_0:
            return value + (values[self.at_motor0] if self.at_motor0 is not None else 0)
        if predictor == LAST_MAIN_TIME:
            return value + (self.last_time or 0)
        if not base:
            return value
        if predictor == INC:
            return base[0][i] + 1 + self._count_skipped()
        if predictor == PREVIOUS:
            return value + base[0][i]
        if predictor == STRAIGHT_LINE:
            return value + 2 * base[0][i] - base[1][i]
        if predictor == AVERAGE_2:
            return value + int((base[0][i] + base[1][i]) / 2)  # C rounds towards zero
        raise Corrupt

    def _count_skipped(self) -> int:
        """Return the number of iterations after the last main frame that are not logged, by the
        header's sampling.
        """
        if self.last_iteration is None:
            return 0
        following = range(self.last_iteration + 1, self.last_iteration + 1 + self.interval)
        logged = (
            (i % self.interval + self.p_num - 1) % self.p_denom < self.p_num for i in following
        )
        return next((count for count, keep in enumerate(logged) if keep), self.interval)

    def _continuous(self, values: Frame, kind: str) -> bool:
        """Return whether time and iteration follow those of the last frame. After a rejected I
        frame, the next one is accepted at any time.
        """
        if self.last_time is None:
            return True
        passed = values[self.at_time] - self.last_time
        if passed < -(1 << 31):  # the 32-bit clock turned over
            passed += 1 << 32
        iterations = values[self.at_iteration] - self.last_iteration
        if 0 <= passed <= _LONGEST_GAP_US and 0 <= iterations <= _MOST_ITERATIONS:
            return True
        if kind == "I":
            self.last_time = self.last_iteration = None
        return False


def _event(reader: Reader) -> tuple[str, tuple[float, ...]] | None:
    kind = reader.byte()
    if kind not in _EVENTS:
        return None
    if kind == 255:
        text = b"End of log"
        matches = reader.data[reader.pos : reader.pos + len(text)] == text
        return (_EVENTS[kind], ()) if matches else None
    if kind == 13:
        function = reader.byte()
        return _EVENTS[kind], (
            function & 127,
            reader.float32() if function & 128 else reader.signed(),
        )
    return _EVENTS[kind], tuple(reader.unsigned() for _ in range(2 if kind in (14, 30) else 1))


def _numbers(text: str, key: str) -> list[int]:
    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise LogError(
            f"header '{key}' is '{text}'; expected whole numbers separated by commas"
        ) from None


def _int(header: dict[str, str], key: str, default: int = 0) -> int:
    with contextlib.suppress(ValueError):
        return int(header.get(key, default))
    return default
