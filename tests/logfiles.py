"""Writers of small autopilot logs, byte by byte after their formats' descriptions, for tests of the
readers.
"""

import struct
from pathlib import Path

DATAFLASH = {
    "Q": "Q",
    "I": "I",
    "L": "i",
    "f": "f",
    "c": "h",
    "C": "H",
    "e": "i",
    "B": "B",
    "b": "b",
    "h": "h",
    "H": "H",
    "N": "16s",
    "Z": "64s",
}
SCALED = {"c": 100, "C": 100, "e": 100, "L": 10_000_000}
FMT = 128

VISP = ("QQIffffffffBBb", "TimeUS,RTimeUS,CTimeMS,PX,PY,PZ,R,P,Y,PErr,AErr,Rst,Ign,Q")
VISP_OLD = ("QQIffffffffBB", "TimeUS,RTimeUS,CTimeMS,PX,PY,PZ,Roll,Pitch,Yaw,PErr,AErr,Rst,Ign")
XKF1 = ("QBccCfffffffccce", "TimeUS,C,Roll,Pitch,Yaw,VN,VE,VD,dPD,PN,PE,PD,GX,GY,GZ,OH")
POS = ("QLLfff", "TimeUS,Lat,Lng,Alt,RelHomeAlt,RelOriginAlt")
ATT = ("Qffffff", "TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw")
ORGN = ("QBLLe", "TimeUS,Type,Lat,Lng,Alt")


def write_bin(
    path: Path, formats: dict[str, tuple[str, str]], rows: list[tuple[str, tuple]]
) -> None:
    """A dataflash log: an FMT record a message, then the messages, values in the units of their
    names.
    """
    types = {name: 130 + i for i, name in enumerate(formats)}
    out = [_fmt(FMT, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89)]
    for name, (kinds, columns) in formats.items():
        size = 3 + struct.calcsize("<" + "".join(DATAFLASH[k] for k in kinds))
        out.append(_fmt(types[name], name, kinds, columns, size))
    for name, values in rows:
        kinds = formats[name][0]
        numbers = [
            round(v * SCALED[k]) if k in SCALED else v for k, v in zip(kinds, values, strict=True)
        ]
        body = struct.pack("<" + "".join(DATAFLASH[k] for k in kinds), *numbers)
        out.append(bytes((0xA3, 0x95, types[name])) + body)
    path.write_bytes(b"".join(out))


def _fmt(kind: int, name: str, kinds: str, columns: str, size: int) -> bytes:
    fields = (name.encode(), kinds.encode(), columns.encode())
    return bytes((0xA3, 0x95, FMT)) + struct.pack("<BB4s16s64s", kind, size, *fields)


ULOG = {"uint64_t": "Q", "uint8_t": "B", "float": "f", "double": "d", "int8_t": "b"}
ULOG |= {"int32_t": "i"}


def write_ulg(
    path: Path,
    topics: dict[tuple[str, int], tuple[list[str], list[tuple]]],
    parameters: dict[str, float] | None = None,
) -> None:
    """A ULog: topic and instance -> its fields ("float[3] position") and its rows, flat, the time
    stamp first [us]; and the autopilot's parameters.
    """
    out = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)]
    for name, value in (parameters or {}).items():
        key = f"{'int32_t' if isinstance(value, int) else 'float'} {name}".encode()
        packed = struct.pack("<i" if isinstance(value, int) else "<f", value)
        out.append(_message("P", bytes((len(key),)) + key + packed))
    names = {name: fields for (name, _), (fields, _) in topics.items()}
    for name, fields in names.items():
        out.append(_message("F", f"{name}:{''.join(field + ';' for field in fields)}".encode()))
    samples = []
    for number, ((name, instance), (fields, rows)) in enumerate(topics.items()):
        out.append(_message("A", struct.pack("<BH", instance, number) + name.encode()))
        layout = "<" + "".join(_layout(field) for field in fields)
        samples += [
            (row[0], _message("D", struct.pack("<H", number) + struct.pack(layout, *row)))
            for row in rows
        ]
    path.write_bytes(
        b"".join(out + [data for _, data in sorted(samples, key=lambda sample: sample[0])])
    )


def _layout(field: str) -> str:
    kind, count = field.split()[0].removesuffix("]").partition("[")[::2]
    return (count or "1") + ULOG[kind]


def _message(kind: str, data: bytes) -> bytes:
    return struct.pack("<HB", len(data), ord(kind)) + data
