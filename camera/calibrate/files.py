"""Reading of other tools' calibration files. A file's keys identify the tool.

Kalibr and OpenVINS chains, EuRoC's sensor.yaml, camodocal and VINS-Fusion, SVO and maplab, OKVIS,
vikit, ORB-SLAM, stella_vslam, MINS, BoofCV, basalt, ROS camera_info (as a file or as printed by
``topic echo``), OpenCV's FileStorage, OCamCalib and py-OCamCalib; in YAML, JSON or XML, with one or
several cameras. ``tools.toml`` describes the format of each tool; `camera.calibrate.foreign`
implements the lens models.

Convention: pixel (0, 0) is the centre of the top left pixel, x right, y down, z forward, as in
`FisheyeParams`. These formats have no field of view. It is read from an additional key ``fov_deg``,
which the tools' own readers ignore; else it is the argument ``fov_deg`` [deg], or by default the
angle of the image's farthest corner."""

import math
import re
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from camera.calibrate.foreign import (
    DISTORTIONS,
    LARGEST_DECENTRING,
    FitReport,
    fit_fisheye,
    image_fov_deg,
)
from camera.mount import DOWNWARD_ROT_CB
from camera.params import FisheyeParams, MountParams, monotonic_limit

Node = dict[str, Any]
Values = dict[str, float]
Entry = tuple[str, Node, str]
"""A camera in a file: its tool, its node and its name in the file."""
Camera = tuple[str, Values]
"""Name of the model in `camera.calibrate.foreign.project`, and its numbers."""

KB4 = "fx fy cx cy k1 k2 k3 k4"
LABELS = {
    "kb4": "kb4 equidistant equi fisheye kannalabrandt kannalabrandt4 kannalabrandt8 opencvfisheye",
    "radtan": (
        "radtan radialtangential plumbbob rationalpolynomial brownconrady modifiedbrownconrady"
        " inversebrownconrady opencv pinholeradtan8"
    ),
    "fov": "fov atan",
    "none": "none",
}
"""Distortion -> its names in various tools, in lower case without punctuation."""


NOT_A_ROTATION = 1e-3  # largest entry of R R^T - 1


def read(
    path: str | Path, camera: int | str = 0, fov_deg: float | None = None, model: str | None = None
) -> tuple[str, FisheyeParams, FitReport]:
    """Read a calibration file.

    Raises ValueError: the file is missing, not text, of an unknown tool or model, or its numbers
    are not a valid lens. The message names the file.

    Args:
        path: The file.
        camera: Index from 0, or name, of the camera in a file with several cameras.
        fov_deg: Full field of view if the file has none [deg].
        model: Distortion model, a key of `LABELS`, if the file's is missing or wrong.

    Returns:
        The tool that writes such files, the fisheye, and the error of a fit to another lens model
        (zero if the file uses ours).
    """
    try:
        cameras = _cameras_of(path)
        if not cameras:
            named = re.findall(r"[\w./-]+\.ya?ml", Path(path).read_text())
            hint = f"; it names {', '.join(dict.fromkeys(named))}: one of these?" if named else ""
            raise ValueError(
                f"holds no camera of a known tool; expected one of {', '.join(BOXES)}{hint}"
            )
        box, node, name = _choose_camera(cameras, camera)
        node = {**node, "asked_model": model} if model else node
        lens, report = _lens(*_camera(box, node), node, fov_deg)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if len(cameras) > 1:
        names = ", ".join(entry[2] for entry in cameras)
        remark = f"camera {name} of {len(cameras)} in the file ({names})"
        report = replace(report, remarks=(remark, *report.remarks))
    return box, lens, report


def read_mount(path: str | Path, camera: int | str = 0) -> MountParams | None:
    """Read the mount from Kalibr's ``T_cam_imu`` (OpenVINS: ``T_imu_cam``); None if the file has
    neither.

    Convention: the IMU is at the centre of mass, and its axes are the body's (x forward, y left, z
    up). Raises ValueError: not a 4 x 4 matrix with a rotation."""
    from scipy.spatial.transform import Rotation

    _, node, _ = _choose_camera(_cameras_of(path), camera)
    key = next((key for key in ("T_cam_imu", "T_imu_cam") if key in node), None)
    if key is None:
        return None
    try:
        matrix = np.array(node[key], dtype=float).reshape(4, 4)
    except (TypeError, ValueError):
        raise ValueError(f"{path}: {key} is {node[key]!r}; expected a 4 x 4 matrix") from None
    if np.abs(matrix[:3, :3] @ matrix[:3, :3].T - np.eye(3)).max() > NOT_A_ROTATION:
        raise ValueError(f"{path}: {key} has no rotation in its first three rows and columns")
    rot_cb = matrix[:3, :3]
    place_c = matrix[:3, 3]
    position_b = -rot_cb.T @ place_c
    if key == "T_imu_cam":
        rot_cb = matrix[:3, :3].T
        position_b = place_c
    turn = Rotation.from_matrix(rot_cb.T @ DOWNWARD_ROT_CB)
    return MountParams(
        tuple(position_b.tolist()), tuple(turn.as_euler("xyz", degrees=True).tolist())
    )


def _choose_camera(entries: list[Entry], camera: int | str) -> Entry:
    names = [name for *_, name in entries]
    number = int(camera) if str(camera).isdigit() else -1
    if camera in names:
        return entries[names.index(str(camera))]
    if 0 <= number < len(entries):
        return entries[number]
    raise ValueError(
        f"camera {camera} was requested; expected a number below {len(entries)}, the cameras in the"
        f" file, or one of their names: {', '.join(names)}"
    )


# Parsing of a file to a tree of mappings and lists


def _tree(path: str | Path) -> Any:
    """Parse a YAML, JSON (as YAML) or XML file, or OCamCalib's text."""
    if not Path(path).is_file():
        raise ValueError("not a file; expected a calibration file")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig").replace("\r\n", "\n").strip()
    except UnicodeDecodeError as error:
        raise ValueError(f"not text ({error}); expected a calibration file") from error
    if text.startswith("<"):
        return _tree_of_xml(text)
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and all(re.fullmatch(r"[-+.\deE\s]+", line) for line in lines):
        return {"ocam_lines": [line.split() for line in lines]}
    return _tree_of_yaml(text)


def _tree_of_yaml(text: str) -> Any:
    """Parse the first document that is a mapping or a list. OpenCV's header and tags are
    removed.
    """
    import yaml

    text = re.sub(r"\A%YAML[^\n]*\n|!!opencv-matrix", "", text).replace("\t", "    ")
    text = re.sub(r"(?m)^(\s*[\w.]+):(?=[\[\d-])", r"\1: ", text)  # OpenCV omits this blank
    try:
        documents = list(yaml.safe_load_all(text))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"is not complete YAML (cut short?): {error}") from error
    return next((tree for tree in documents if isinstance(tree, dict | list)), None)


def _tree_of_xml(text: str) -> Any:
    from xml.etree import ElementTree

    def tree_of(element: ElementTree.Element) -> Any:
        if len(element):
            return {child.tag: tree_of(child) for child in element}
        words = (element.text or "").split()
        return words if element.tag == "data" else " ".join(words)

    try:
        return tree_of(ElementTree.fromstring(text))
    except ElementTree.ParseError as error:
        raise ValueError(f"is not complete XML (cut short?): {error}") from error


def _cameras_of(path: str | Path) -> list[Entry]:
    """Return the cameras of a file, identified by unique names or by their index."""
    cameras = list(_cameras(_tree(path)))
    names = [name for *_, name in cameras]
    named = []
    for i, (box, node, name) in enumerate(cameras):
        unique = name and names.count(name) == 1
        named.append((box, node, name if unique else str(i)))
    return named


def _cameras(tree: Any, name: str = "") -> Iterator[Entry]:
    """Yield each camera in a tree: its tool, its node and its name."""
    if isinstance(tree, list):
        named: dict[Any, Any] = dict(enumerate(tree))
    elif isinstance(tree, dict):
        named = tree = _uniform(tree)
        for box, tool in BOXES.items():
            if all(_has(tree, names) for names in tool["has"]):
                yield box, tree, str(tree.get("label", name) or name)
                return
    else:
        return
    for key, entry in named.items():
        yield from _cameras(entry, name if key in ("camera", "value0", "cameras") else str(key))


def _uniform(tree: Node) -> Node:
    """Normalise a tree: combine basalt's separate lists of intrinsics and resolutions by camera,
    and rename ORB-SLAM's ``Camera1`` to ``Camera``.
    """
    lenses = tree.get("intrinsics") if "resolution" in tree else None
    if isinstance(lenses, list) and lenses and isinstance(lenses[0], dict):
        sizes = tree["resolution"]
        sizes = sizes[: len(lenses)] if isinstance(sizes, list) else [sizes]
        pairs = zip_longest(lenses, sizes)
        return {f"cam{i}": {**lens, "resolution": size} for i, (lens, size) in enumerate(pairs)}
    return {re.sub(r"^Camera1\.", "Camera.", str(key)): entry for key, entry in tree.items()}


# Numbers in a tree


def _find(node: Node, names: str) -> Any:
    """Return the value of the first key that exists, or None. A dot separates the keys of nested
    mappings and the indices of lists.
    """
    for name in names.split():
        value: Any = node
        for part in [name] if name in node else name.split("."):
            if isinstance(value, list) and part.isdigit() and int(part) < len(value):
                value = value[int(part)]
            elif isinstance(value, dict):
                value = value.get(part)
            else:
                value = None
        if value is not None:
            return value
    return None


def _has(node: Node, names: str) -> bool:
    return any(name in node for name in names.split()) or _find(node, names) is not None


def _find_any(node: Node, names: str) -> Any:
    """Return the value of the first key that exists. Raises ValueError: none exists."""
    value = _find(node, names)
    if value is None:
        keys = " or ".join(map(repr, names.split()))
        raise ValueError(f"lacks the key {keys} (cut short?); it has {sorted(map(str, node))}")
    return value


def _floats(value: Any, name: str, count: int | None = None) -> list[float]:
    """Return ``count`` numbers from a list, a list of lists, or the ``data`` of a matrix."""
    flat = value.get("data", value) if isinstance(value, dict) else value
    if isinstance(flat, list) and all(isinstance(row, list) for row in flat):
        flat = list(chain.from_iterable(flat))
    try:
        numbers = [float(cell) for cell in flat if not isinstance(cell, bool)]
        if isinstance(flat, str) or (count and len(numbers) != count):
            raise ValueError
    except (TypeError, ValueError):
        text = repr(value)
        if len(text) > 80:
            text = text[:77] + "..."
        raise ValueError(f"{name} is {text}; expected {count or 'some'} numbers") from None
    return numbers


def _number(node: Node, place: str) -> float:
    """Return the number at a place in the notation of `tools.toml`."""
    if place.replace(".", "").isdigit():
        return float(place)
    name = place.removesuffix("?")
    value = _find(node, name) if name != place else _find_any(node, name)
    if value is None:
        return 0.0
    return _floats([value], name)[0]


def _values(node: Node, numbers: list[str]) -> Values:
    """Return a camera's numbers by our names; ``numbers``: in the notation of `tools.toml`."""
    values: Values = {}
    for spec in numbers:
        places, listed, names = spec.rpartition(": ")
        if listed:
            cells = _floats(_find_any(node, places), places.split()[0], len(names.split()))
            values |= dict(zip(names.split(), cells))
        else:
            for word in spec.split():
                ours, _, theirs = word.partition("=")
                values[ours] = _number(node, theirs or ours)
    values.pop("_", None)
    return values


def _label(node: Node, tool: Node) -> str:
    """Return our name of a camera's distortion model."""
    word = str(node.get("asked_model") or _find_any(node, tool["label"]))
    plain = re.sub(r"[^a-z0-9]", "", word.lower())
    if not node.get("asked_model"):
        plain = tool.get("labels", {}).get(plain, plain)
    for model, words in LABELS.items():
        if plain in words.split():
            return model
    raise ValueError(f"distortion model {word!r}; expected one of {list(LABELS)}, or their names")


def _model(core: str, distortion: str, values: Values, coefficients: list[float]) -> Camera:
    """Combine a core, its distortion and the coefficients. Surplus coefficients must be zero."""
    if core == "pinhole" and distortion == "kb4":
        core = "kb4"
        distortion = "none"
        names = KB4.split()[4:]
    elif distortion == "kb4":
        raise ValueError(f"model '{core}' with equidistant distortion; no tool writes that")
    else:
        names = DISTORTIONS[distortion][0].split()
    if len(coefficients) < (4 if core == "kb4" else len(names[:4])):
        raise ValueError(
            f"{len(coefficients)} distortion coefficients {coefficients}; expected"
            f" {' '.join(names[:4])}"
        )
    if any(coefficients[len(names) :]):
        raise ValueError(
            f"distortion coefficients {coefficients}; the {distortion} model has {' '.join(names)},"
            " and those beyond are not zero: another model, such as a thin prism"
        )
    values = values | dict(zip(names, coefficients))
    return (core if distortion == "none" else f"{core}-{distortion}"), values


# Formats of the tools


BOXES: dict[str, Node] = tomllib.loads(
    Path(__file__).with_name("tools.toml").read_text(encoding="utf-8")
)
"""Tool -> format of its files."""


def _camera(box: str, node: Node) -> Camera:
    """Read the model and the numbers of a camera in a tool's file."""
    tool = BOXES[box]
    if "kind" in tool:
        word = str(_find(node, tool["kind"]) or tool.get("default", ""))
        kind = word.lower()
        models = tool["models"]
        if kind not in models:
            name = next((name for name in tool["kind"].split() if name in node), tool["kind"])
            raise ValueError(f"{name} is {word!r}; expected one of {list(models)}")
        tool = {"model": kind} | tool | models[kind]
    for key, reason in tool.get("refuses", {}).items():
        if key in node:
            raise ValueError(reason)
    if box == "ocam":
        return "ocam", _ocam(node)
    if tool.get("flat"):
        inner = [part for key, part in node.items() if isinstance(part, dict) and "inv" not in key]
        node = {key: value for part in (node, *inner) for key, value in part.items()}
    section = node[tool["within"]] if "within" in tool else node
    values = _values(section, [*tool["numbers"], tool.get("more", "")])
    core = tool.get("model", "pinhole")
    places = tool.get("coefficients", "")
    if not places or ("optional" in tool and not _has(node, tool["optional"])):
        return core, values
    if tool.get("terms"):
        coefficients = [_number(node, place) for place in places.split()]
    else:
        coefficients = _floats(_find_any(node, places), places.split()[0])
    if box == "ros or opencv":
        node = _add_distortion_name(node, len(coefficients))
        coefficients += [0.0] * (4 - len(coefficients))
    elif box == "vikit" and values["fx"] < 10.0:
        values = _pixels_of_shares(values, _size(node) or (0, 0))
    return _model(core, tool.get("distortion") or _label(node, tool), values, coefficients)


def _add_distortion_name(node: Node, count: int) -> Node:
    """Return ROS' camera_info or OpenCV's FileStorage with the name of its distortion, which may be
    derived from a flag or the number of coefficients.
    """
    flag = node.get("fisheye_model")
    if flag is not None:
        return {**node, "distortion_model": "fisheye" if int(flag) else "radtan"}
    if node.get("distortion_model") or node.get("asked_model"):
        return node
    if count in (5, 8, 12, 14):
        return {**node, "distortion_model": "radtan"}
    raise ValueError(
        f"{count} distortion coefficients and no name of their model; say it with"
        " --model kb4 or --model radtan"
    )


def _pixels_of_shares(values: Values, size: tuple[int, int]) -> Values:
    """Convert intrinsics in shares of the image's size, from its corner, to pixels."""
    width, height = size
    pixels = {"fx": values["fx"] * width, "fy": values["fy"] * height}
    return pixels | {"cx": values["cx"] * width - 0.5, "cy": values["cy"] * height - 0.5}


def _ocam(node: Node) -> Values:
    """Read the numbers of OCamCalib's "export data" or py-OCamCalib's JSON; a0 is negative."""
    if "taylor_coefficient" in node:
        depth = [-a for a in _floats(node["taylor_coefficient"], "taylor_coefficient")]
        stretch = _values(node, ["distortion_center: cx cy", "stretch_matrix: fx skew shear fy"])
    else:
        lines = node["ocam_lines"]
        if len(lines) < 5:
            raise ValueError(
                f"{len(lines)} lines of numbers; expected five: direct polynomial, inverse"
                " polynomial, centre, affine part c d e, height and width (cut short?)"
            )
        count, *depth = _floats(lines[0], "direct polynomial")
        cy, cx = _floats(lines[2], "centre", 2)
        fy, shear, skew = _floats(lines[3], "affine part c d e", 3)
        stretch = {"fx": 1.0, "skew": skew, "shear": shear, "fy": fy, "cx": cx, "cy": cy}
        if len(depth) != int(count):
            raise ValueError(f"direct polynomial of {len(depth)} coefficients; announced {count:g}")
    return {f"a{i}": a for i, a in enumerate(depth)} | stretch


# Conversion to our lens


def _size(node: Node) -> tuple[int, int] | None:
    """Return width and height [px]; None if the file does not contain them."""
    if "ocam_lines" in node:
        height, width = _floats(node["ocam_lines"][4], "height and width", 2)
        return int(width), int(height)
    pair = "resolution cameraResolution image_size imageSize img_size image_dimension"
    if (value := _find(node, pair)) is not None:
        width, height = _floats(value, "image size", 2)
        return int(width), int(height)
    places = "image_{0} image_{1} {0} cam_{0} Camera.{0} Camera.{2} pinhole.{0}"
    sides = (("width", "Width", "cols"), ("height", "Height", "rows"))
    sizes = [_find(node, places.format(*names)) for names in sides]
    if None in sizes:
        return None
    width, height = _floats(sizes, "image size")
    return int(width), int(height)


def _lens(
    model: str, values: Values, node: Node, asked_fov: float | None
) -> tuple[FisheyeParams, FitReport]:
    """Return our lens, read or fitted, and a report with warnings about the file's numbers."""
    remarks = []
    for name, value in values.items():
        if not math.isfinite(value):
            raise ValueError(f"{name} is {value}; expected a finite number")
    size = _size(node)
    if size is None:
        size = (round(2.0 * values["cx"] + 1.0), round(2.0 * values["cy"] + 1.0))
        remarks.append(
            f"the file holds no image size: {size[0]} x {size[1]} px, twice its principal point, is"
            " taken; add image_width and image_height to it"
        )
    model, notes = _contradictions(model, values, size, bool(node.get("asked_model")))
    remarks += notes
    fov = asked_fov
    if node.get("fov_deg") is not None:
        fov = _floats([node["fov_deg"]], "fov_deg")[0]
    if model != "kb4" or values.get("skew", 0.0):
        lens, report = _fit_lens(model, values, size, fov)
        return lens, replace(report, remarks=(*remarks, *report.remarks))
    fx, fy, cx, cy, k1, k2, k3, k4 = (values[name] for name in KB4.split())
    limit = math.degrees(monotonic_limit((k1, k2, k3, k4)))
    narrow = min(1.0, 1.9 * limit)  # until the image's field of view is computed
    lens = FisheyeParams(*size, fx, fy, cx, cy, k1, k2, k3, k4, narrow if fov is None else fov)
    if fov is None:
        lens = replace(lens, fov_deg=image_fov_deg(lens))
        if lens.fov_deg > 1.99999 * limit:
            remarks.append(
                f"its numbers fold back {limit:.1f} deg off the axis, inside the image: the field"
                " of view ends there"
            )
    return lens, FitReport("kb4", remarks=tuple(remarks))


def _fit_lens(
    model: str, values: Values, size: tuple[int, int], fov: float | None
) -> tuple[FisheyeParams, FitReport]:
    """Fit our lens; for ocam's polynomial, the distance of the image's farthest corner is added."""
    core = model.partition("-")[0]
    if core == "ocam":
        x, y = values["cx"], values["cy"]
        width, height = size
        corner = math.hypot(max(x, width - x), max(y, height - y))
        values = values | {"farthest": 1.1 * corner}
        flat = values["fx"] * values["fy"] == values["skew"] * values["shear"]
        if flat or not values["a0"] < 0.0:
            raise ValueError(f"direct polynomial begins with {values['a0']:g}; expected below 0")
    return fit_fisheye(model, values, *size, fov)


def _contradictions(
    model: str, values: Values, size: tuple[int, int], labelled: bool
) -> tuple[str, list[str]]:
    """Return the model of a file's numbers, and warnings about contradictions to its label."""
    names = values.keys() & {"k1", "k2", "k3", "k4", "p1", "p2", "k5", "k6", "w"}
    remarks = []
    if names and not any(values[k] for k in names):
        if math.isclose(values["fx"], size[0] / math.pi, rel_tol=1e-4):
            focal = "; its focal length is the image's width over pi"
        else:
            focal = ""
        remarks.append(
            f"all distortion coefficients are zero{focal}: was this lens calibrated, or are its"
            " pictures rectified?"
        )
    if model == "pinhole-radtan" and not labelled:
        k1, k2, k3, k4 = (values.get(k, 0.0) for k in ("k1", "k2", "p1", "p2"))
        higher_terms = any(values.get(k, 0.0) for k in ("k3", "k4", "k5", "k6"))
        tangential = max(abs(k3), abs(k4))
        if tangential > LARGEST_DECENTRING and not higher_terms:
            values |= {"k1": k1, "k2": k2, "k3": k3, "k4": k4}
            remarks.append(
                f"its label says radial and tangential distortion, but no lens has p = {k3:g},"
                f" {k4:g}: the numbers are taken as Kannala-Brandt's k1 to k4, as a RealSense T265"
                " writes them; --model radtan takes the label"
            )
            return "kb4", remarks
    return model, remarks
