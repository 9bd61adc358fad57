"""Calibration files of the field, as our lens: which tool wrote a file is told from its keys.

Kalibr and OpenVINS chains, EuRoC's sensor.yaml, camodocal and VINS-Fusion, SVO and maplab, OKVIS,
vikit, ORB-SLAM, stella_vslam, MINS, BoofCV, basalt, ROS camera_info (as a file or as ``topic
echo`` prints it), OpenCV's FileStorage, OCamCalib and py-OCamCalib; in YAML, JSON or XML, with one
or several cameras. A box says where the numbers of a camera stand; `camera.calibrate.foreign`
knows the models.

Convention: pixel (0, 0) is the centre of the top left pixel, x right, y down, z forward, as in
`FisheyeParams`. None of the files holds a field of view; it is read from an extra key ``fov_deg``,
which their own readers ignore. A file without it gets the ``fov_deg`` of the call [deg] or, that
left out, the angle that the farthest corner of the image sees."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from camera.calibrate.foreign import (
    ANGULAR,
    DENOMINATORS,
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
Camera = tuple[str, Values]
"""Model, as `camera.calibrate.foreign.project` calls it, and its numbers."""

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
"""Distortion -> what tools call it, in small letters without signs."""


NOT_A_ROTATION = 1e-3  # largest entry of R R^T - 1


class _Missing(ValueError):
    """A key that a file should hold."""


def read(
    path: str | Path, camera: int | str = 0, fov_deg: float | None = None, model: str | None = None
) -> tuple[str, FisheyeParams, FitReport]:
    """Read a calibration file.

    Raises ValueError: the file is missing, no text, of no known tool or model, or its numbers
    describe no lens; the message names the file.

    Args:
        path: The file.
        camera: Number from 0, or name, of the camera in a file that holds several.
        fov_deg: Full field of view where the file has none [deg].
        model: Distortion model, a key of `LABELS`, where the file names none or a wrong one.

    Returns:
        The tool that writes such files, the fisheye, and what a fit of another lens model left over
        (zero where the file holds ours).
    """
    try:
        cameras = _cameras_of(path)
        if not cameras:
            named = re.findall(r"[\w./-]+\.ya?ml", Path(path).read_text())
            hint = f"; it names {', '.join(dict.fromkeys(named))}: one of these?" if named else ""
            raise ValueError(
                f"holds no camera of a known tool; expected one of {', '.join(BOXES)}{hint}"
            )
        box, node, name = _chosen(cameras, camera)
        node = {**node, "asked_model": model} if model else node
        lens, report = _lens(*BOXES[box][1](node), node, fov_deg)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if len(cameras) > 1:
        names = ", ".join(entry[2] for entry in cameras)
        report = replace(
            report,
            remarks=(f"camera {name} of {len(cameras)} in the file ({names})", *report.remarks),
        )
    return box, lens, report


def read_mount(path: str | Path, camera: int | str = 0) -> MountParams | None:
    """Return the mount of Kalibr's ``T_cam_imu`` (OpenVINS: ``T_imu_cam``), or None where a file
    states neither.

    Convention: the IMU sits at the centre of mass, its axes are the body's (x forward, y left, z
    up). Raises ValueError: no 4 x 4 matrix with a rotation."""
    _, node, _ = _chosen(_cameras_of(path), camera)
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
    turn = (rot_cb.T @ np.array(DOWNWARD_ROT_CB)).tolist()
    roll = math.atan2(turn[2][1], turn[2][2])
    pitch = math.asin(max(-1.0, min(1.0, -turn[2][0])))
    yaw = math.atan2(turn[1][0], turn[0][0])
    x, y, z = position_b.tolist()
    return MountParams((x, y, z), (math.degrees(roll), math.degrees(pitch), math.degrees(yaw)))


def _chosen(entries: list[tuple[str, Node, str]], camera: int | str) -> tuple[str, Node, str]:
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


# What a file holds: a tree of mappings and lists


def _tree(path: str | Path) -> Any:
    """Mappings and lists of a YAML, JSON or XML file, or of OCamCalib's text."""
    if not Path(path).is_file():
        raise ValueError("not a file; expected a calibration file")
    try:
        text = Path(path).read_bytes().decode("utf-8-sig").replace("\r\n", "\n").strip()
    except UnicodeDecodeError as error:
        raise ValueError(f"no text ({error}); expected a calibration file") from error
    if text.startswith("<"):
        return _tree_of_xml(text)
    if text.startswith("{"):
        try:
            return json.loads(text)
        except json.JSONDecodeError:
            pass  # YAML's mappings may begin with a brace too
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and all(re.fullmatch(r"[-+.\deE\s]+", line) for line in lines):
        return {"ocam_lines": [line.split() for line in lines]}
    return _tree_of_yaml(text)


def _tree_of_yaml(text: str) -> Any:
    """First document that is a mapping or a list; OpenCV's head and tags are passed over."""
    import yaml

    text = re.sub(r"\A%YAML[^\n]*\n|!!opencv-matrix", "", text).replace("\t", "    ")
    text = re.sub(r"(?m)^(\s*[\w.]+):(?=[\[\d-])", r"\1: ", text)  # OpenCV needs no blank there
    try:
        documents = list(yaml.safe_load_all(text))
    except (yaml.YAMLError, ValueError) as error:
        raise ValueError(f"is no complete YAML (cut short?): {error}") from error
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
        raise ValueError(f"is no complete XML (cut short?): {error}") from error


def _cameras_of(path: str | Path) -> list[tuple[str, Node, str]]:
    """Cameras of a file, each by a name of its own or its number."""
    cameras = _cameras(_tree(path))
    names = [name for *_, name in cameras]
    return [
        (box, node, name if name and names.count(name) == 1 else str(i))
        for i, (box, node, name) in enumerate(cameras)
    ]


def _cameras(tree: Any, name: str = "") -> list[tuple[str, Node, str]]:
    """Each camera in a tree: its box, its node and what it is called there."""
    if isinstance(tree, list):
        named = [(str(i), entry) for i, entry in enumerate(tree)]
    elif isinstance(tree, dict):
        tree = _uniform(tree)
        keys = {str(key) for key in tree}
        box = next((box for box, (matches, _) in BOXES.items() if matches(keys)), "")
        if box:
            return [(box, tree, str(tree.get("label", name) or name))]
        named = [(str(key), entry) for key, entry in tree.items()]
    else:
        return []
    return [
        entries
        for key, entry in named
        for entries in _cameras(entry, name if key in ("camera", "value0", "cameras") else key)
    ]


def _uniform(tree: Node) -> Node:
    """Put basalt's cameras, whose intrinsics and resolutions stand in two lists, one beside the
    other, and ``Camera.`` before the keys of stella_vslam.
    """
    lenses = tree.get("intrinsics") if "resolution" in tree else None
    if isinstance(lenses, list) and lenses and isinstance(lenses[0], dict):
        sizes = tree["resolution"]
        sizes = sizes[: len(lenses)] if isinstance(sizes, list) else [sizes]
        pairs = zip_longest(lenses, sizes)
        return {f"cam{i}": {**lens, "resolution": size} for i, (lens, size) in enumerate(pairs)}
    if {"model", "fx", "cols"} <= tree.keys():
        return {f"Camera.{key}": entry for key, entry in tree.items()}
    return tree


# Numbers in it


def _any(node: Node, *names: str) -> Any:
    """Return the value of the first key that exists; a dot leads into a mapping."""
    for name in names:
        value: Any = node
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is not None:
            return value
    raise _Missing(
        f"lacks the key {' or '.join(map(repr, names))} (cut short?); it has"
        f" {sorted(map(str, node))}"
    )


def _floats(value: Any, name: str, counts: tuple[int, ...] | None = None) -> list[float]:
    """Return so many numbers from a list, a list of lists, or the ``data`` of a matrix."""
    flat = value.get("data", value) if isinstance(value, dict) else value
    if isinstance(flat, list) and all(isinstance(row, list) for row in flat):
        flat = list(chain.from_iterable(flat))
    try:
        numbers = [float(cell) for cell in flat if not isinstance(cell, bool)]
        if isinstance(flat, str) or (counts and len(numbers) not in counts):
            raise ValueError
    except (TypeError, ValueError):
        expected = " or ".join(map(str, counts or ("some",)))
        text = repr(value)
        text = text if len(text) <= 80 else text[:77] + "..."
        raise ValueError(f"{name} is {text}; expected {expected} numbers") from None
    return numbers


def _named(node: Node, names: str, section: str = "") -> Values:
    """Numbers that stand under their own names."""
    section_node = _any(node, section) if section else node
    words = names.split()
    return dict(zip(words, _floats([_any(section_node, word) for word in words], names)))


def _label(node: Node, *names: str) -> str:
    """Distortion model by whatever name a tool gives it."""
    model_name = node.get("asked_model")
    word = str(model_name if model_name else _any(node, *names))
    plain = re.sub(r"[^a-z0-9]", "", word.lower())
    for model, words in LABELS.items():
        if plain in words.split():
            return model
    raise ValueError(f"distortion model {word!r}; expected one of {list(LABELS)}, or their names")


def _model(core: str, distortion: str, values: Values, coefficients: list[float]) -> Camera:
    """Model of a core and its distortion; coefficients beyond those of the model must be zero."""
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


# Boxes: where the numbers of one camera stand


def _kalibr(node: Node) -> Camera:
    core = str(node.get("camera_model", node.get("model", "pinhole"))).lower()
    if "omni_affine" in node:
        raise ValueError("Kimera's omni, a polynomial that is not read; expected omni-radtan")
    names = {"pinhole": "", "omni": "xi", "ds": "xi alpha", "eucm": "alpha beta"}
    if core not in names:
        raise ValueError(f"camera_model is {core!r}; expected one of {list(names)}")
    words = f"{names[core]} fx fy cx cy".split()
    values = dict(zip(words, _floats(_any(node, "intrinsics"), "intrinsics", (len(words),))))
    if core in ("ds", "eucm"):
        return core, values
    coefficients_node = _any(node, "distortion_coeffs", "distortion_coefficients")
    coefficients = _floats(coefficients_node, "distortion_coeffs")
    return _model(core, _label(node, "distortion_model"), values, coefficients)


CAMODOCAL = {
    "kannala_brandt": ("kb4", "k1=k2 k2=k3 k3=k4 k4=k5 fx=mu fy=mv cx=u0 cy=v0"),
    "mei": ("omni-radtan", "xi k1 k2 p1 p2 fx=gamma1 fy=gamma2 cx=u0 cy=v0"),
    "pinhole": ("pinhole-radtan", "k1 k2 p1 p2 fx fy cx cy"),
    "pinhole_full": ("pinhole-radtan", "k1 k2 p1 p2 k3 k4 k5 k6 fx fy cx cy"),
    "polyfisheye": ("polyfisheye", "k2 k3 k4 k5 k6 k7 fx=A11 skew=A12 fy=A22 cx=u0 cy=v0"),
    "fishpoly": ("polyfisheye", "k2 k3 k4 k5 k6 k7 fx=A11 skew=A12 fy=A22 cx=u0 cy=v0"),
    "scaramuzza": ("ocam", "fx=ac skew=ad shear=ae cx cy a0=p0 a1=p1 a2=p2 a3=p3 a4=p4"),
}
"""``model_type`` -> our model, and its numbers, with the file's names where they differ."""


def _camodocal(node: Node) -> Camera:
    kind = str(_any(node, "model_type", "cam_model")).lower()
    if kind not in CAMODOCAL:
        raise ValueError(f"model_type is {kind.upper()!r}; expected one of {[*CAMODOCAL]}")
    model, names = CAMODOCAL[kind]
    inner = [entry for key, entry in node.items() if isinstance(entry, dict) and "inv" not in key]
    flat = {key: entry for section in (node, *inner) for key, entry in section.items()}
    pairs = [word.partition("=") for word in names.split()]
    values = {ours: _floats([_any(flat, his or ours)], his or ours)[0] for ours, _, his in pairs}
    return model, values | ({"fy": 1.0} if model == "ocam" else {})


def _svo(node: Node) -> Camera:
    core = str(node["type"]).lower()
    numbers = _floats(_any(node, "intrinsics"), "intrinsics")
    if core == "omni" and len(numbers) == 24:
        values = {f"a{i}": a for i, a in enumerate(numbers[:5])}
        cx, cy, c, d, e = numbers[5:10]
        return "ocam", values | {"cx": cx, "cy": cy, "fx": 1.0, "skew": e, "shear": d, "fy": c}
    if core != "pinhole" or len(numbers) != 4:
        raise ValueError(
            f"type is {core!r} with {len(numbers)} intrinsics; expected 'pinhole' with 4 or 'omni'"
            " with 24"
        )
    values = dict(zip(KB4.split(), numbers))
    if "distortion" not in node and "distortion_coefficients" not in node:
        return "pinhole", values
    coefficients = _any(node, "distortion.parameters", "distortion_coefficients", "distortion.data")
    label = "fov" if _any(node, "distortion.type") == "fisheye" else _label(node, "distortion.type")
    return _model(core, label, values, _floats(coefficients, "distortion.parameters"))


def _okvis(node: Node) -> Camera:
    fx, fy = _floats(node["focal_length"], "focal_length", (2,))
    cx, cy = _floats(_any(node, "principal_point"), "principal_point", (2,))
    coefficients_node = _any(node, "distortion_coefficients")
    coefficients = _floats(coefficients_node, "distortion_coefficients")
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return _model("pinhole", _label(node, "distortion_type"), values, coefficients)


VIKIT = {
    "pinhole": "radtan",
    "pinholeradialtangential": "radtan",
    "pinholenodistortion": "none",
    "pinholeequidistant": "kb4",
    "atan": "fov",
    "pinholeatan": "fov",
}
"""``cam_model`` -> distortion."""


def _vikit(node: Node) -> Camera:
    kind = str(node["cam_model"]).lower()
    if kind not in VIKIT:
        raise ValueError(f"cam_model is {node['cam_model']!r}; expected one of {list(VIKIT)}")
    fx, fy, cx, cy = _floats([_any(node, f"cam_{k}") for k in KB4.split()[:4]], "cam_fx ...")
    if fx < 10.0:  # shares of the image, which count from its corner
        width, height = _size(node) or (0, 0)
        fx = fx * width
        fy = fy * height
        cx = cx * width - 0.5
        cy = cy * height - 0.5
    coefficients = [_floats([node.get(f"cam_d{i}", 0.0)], f"cam_d{i}")[0] for i in range(5)]
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy}
    return _model(
        "pinhole", VIKIT[kind], values, coefficients[: 1 if VIKIT[kind] == "fov" else None]
    )


MATRICES = "camera_matrix cameraMatrix Camera_Matrix K k mtx matrix intrinsic_matrix"
COEFFICIENTS = (
    "distortion_coefficients Distortion_Coefficients dist_coeffs dist_coeff distCoeffs D d dist"
    " distortion"
)
"""Keys of a camera matrix and of its coefficients, as OpenCV's samples and ROS write them."""


def _matrix(node: Node) -> Camera:
    """ROS camera_info and OpenCV's FileStorage: a camera matrix and coefficients."""
    matrix = _any(node, *MATRICES.split())
    fx, skew, cx, _, fy, cy, *_ = _floats(matrix, "camera_matrix", (9,))
    coefficients = _floats(_any(node, *COEFFICIENTS.split()), "distortion_coefficients")
    flag = node.get("fisheye_model")
    if flag is not None:
        node = {**node, "distortion_model": "fisheye" if int(flag) else "radtan"}
    elif not node.get("distortion_model") and len(coefficients) in (5, 8, 12, 14):
        node = {**node, "distortion_model": "radtan"}
    if not node.get("distortion_model") and not node.get("asked_model"):
        raise ValueError(
            f"{len(coefficients)} distortion coefficients and no name of their model; say it with"
            " --model kb4 or --model radtan"
        )
    label = _label(node, "distortion_model")
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": skew}
    return _model("pinhole", label, values, coefficients + [0.0] * (4 - len(coefficients)))


def _orbslam(node: Node) -> Camera:
    head = "Camera1" if "Camera1.fx" in node else "Camera"
    kind = str(node.get("Camera.type", node.get("Camera.model", ""))).lower()
    fisheye = "kannala" in kind or kind == "fisheye"
    plain = {
        key.partition(".")[2]: entry for key, entry in node.items() if key.startswith(head + ".")
    }
    names = KB4.split()[4:] if fisheye else DISTORTIONS["radtan"][0].split()[:5]
    coefficients = [_floats([plain.get(name, 0.0)], name)[0] for name in names]
    values = _named(plain, "fx fy cx cy")
    return _model("pinhole", "kb4" if fisheye else "radtan", values, coefficients)


BOOFCV = {
    "pinhole": ("pinhole", ""),
    "pinhole_radial_tangential": ("pinhole", ""),
    "omnidirectional_universal": ("omni", "mirror_offset"),
}
"""``model`` -> our core, and where its parameter stands."""


def _boofcv(node: Node) -> Camera:
    kind = str(node["model"])
    if kind not in BOOFCV:
        raise ValueError(f"model is {kind!r}; expected one of {list(BOOFCV)}")
    core, offset = BOOFCV[kind]
    values = _named(node, "fx fy cx cy skew", "pinhole")
    if offset:
        values["xi"] = _floats([_any(node, offset)], offset)[0]
    bent = node.get("radial_tangential") or {}
    radial = [*_floats(bent.get("radial") or [], "radial"), 0.0, 0.0, 0.0][:3]
    tangential = _floats([bent.get("t1", 0.0), bent.get("t2", 0.0)], "t1 t2")
    return _model(core, "radtan", values, [*radial[:2], *tangential, radial[2]])


def _basalt(node: Node) -> Camera:
    kind = str(node["camera_type"])
    core, distortion = ("pinhole", "radtan") if kind == "pinhole-radtan8" else (kind, "none")
    names = {"kb4": KB4, "pinhole": "fx fy cx cy"}.get(kind, "")
    if distortion == "radtan":
        names = "fx fy cx cy " + DISTORTIONS["radtan"][0]
    elif core in DENOMINATORS and not names:
        names = f"fx fy cx cy {DENOMINATORS[core][0]}"
    if not names:
        models = ["kb4", "pinhole-radtan8", *DENOMINATORS]
        raise ValueError(f"camera_type is {kind!r}; expected one of {models}")
    return kind.replace("radtan8", "radtan"), _named(node, names, "intrinsics")


def _ocam(node: Node) -> Camera:
    """OCamCalib's "export data" (rows before columns, depth below zero); py-OCamCalib's JSON."""
    if "taylor_coefficient" in node:
        depth = [-a for a in _floats(node["taylor_coefficient"], "taylor_coefficient")]
        cx, cy = _floats(_any(node, "distortion_center"), "distortion_center", (2,))
        fx, skew, shear, fy = _floats(_any(node, "stretch_matrix"), "stretch_matrix", (4,))
    else:
        lines = node["ocam_lines"]
        if len(lines) < 5:
            raise ValueError(
                f"{len(lines)} lines of numbers; expected five: direct polynomial, inverse"
                " polynomial, centre, affine part c d e, height and width (cut short?)"
            )
        count, *depth = _floats(lines[0], "direct polynomial")
        cy, cx = _floats(lines[2], "centre", (2,))
        fy, shear, skew = _floats(lines[3], "affine part c d e", (3,))
        fx = 1.0
        if len(depth) != int(count):
            raise ValueError(f"direct polynomial of {len(depth)} coefficients; announced {count:g}")
    stretch = {"fx": fx, "skew": skew, "shear": shear, "fy": fy, "cx": cx, "cy": cy}
    return "ocam", {f"a{i}": a for i, a in enumerate(depth)} | stretch


def _has(*names: str) -> Callable[[set[str]], bool]:
    return lambda keys: all(keys & set(name.split()) for name in names)


BOXES: dict[str, tuple[Callable[[set[str]], bool], Callable[[Node], Camera]]] = {
    "basalt": (_has("camera_type", "intrinsics"), _basalt),
    "kalibr": (_has("camera_model distortion_model", "intrinsics"), _kalibr),
    "camodocal": (_has("model_type cam_model", "image_width"), _camodocal),
    "svo": (_has("type", "intrinsics"), _svo),
    "okvis": (_has("focal_length", "principal_point"), _okvis),
    "vikit": (_has("cam_model"), _vikit),
    "ros or opencv": (
        _has(f"{MATRICES} distortion_coefficients", f"{COEFFICIENTS} camera_matrix"),
        _matrix,
    ),
    "orb-slam": (_has("Camera.fx Camera1.fx"), _orbslam),
    "boofcv": (_has("pinhole", "model"), _boofcv),
    "ocam": (_has("taylor_coefficient ocam_lines"), _ocam),
}
"""Tool -> whether a mapping with these keys is a camera of its, and what reads it."""


# From the numbers of a file to our lens


def _size(node: Node) -> tuple[int, int] | None:
    """Width and height [px]; None where the file does not say."""
    if "ocam_lines" in node:
        height, width = _floats(node["ocam_lines"][4], "height and width", (2,))
        return int(width), int(height)
    if "pinhole" in node:
        node = node["pinhole"]
    pair = (
        "resolution",
        "cameraResolution",
        "image_size",
        "imageSize",
        "img_size",
        "image_dimension",
    )
    value = next((node[name] for name in pair if node.get(name) is not None), None)
    if value is not None:
        width, height = _floats(value, "image size", (2,))
        return int(width), int(height)
    ends = ("image_{}", "{}", "cam_{}", "Camera.{}")
    sides = [
        (*(end.format(side) for end in ends), f"image_{side.title()}", f"Camera.{lines}")
        for side, lines in (("width", "cols"), ("height", "rows"))
    ]
    sizes = [next((node[n] for n in names if n in node), None) for names in sides]
    if None in sizes:
        return None
    width, height = _floats(sizes, "image size")
    return int(width), int(height)


def _lens(
    model: str, values: Values, node: Node, asked_fov: float | None
) -> tuple[FisheyeParams, FitReport]:
    """Our lens, read or fitted, and what its numbers say against themselves."""
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
        lens, report = _fitted(model, values, size, fov)
        return lens, replace(report, remarks=(*remarks, *report.remarks))
    fx, fy, cx, cy, k1, k2, k3, k4 = (values[name] for name in KB4.split())
    limit = math.degrees(monotonic_limit((k1, k2, k3, k4)))
    narrow = min(1.0, 1.9 * limit)  # until it is known how much the image sees
    lens = FisheyeParams(*size, fx, fy, cx, cy, k1, k2, k3, k4, narrow if fov is None else fov)
    if fov is None:
        lens = replace(lens, fov_deg=image_fov_deg(lens))
        if lens.fov_deg > 1.99999 * limit:
            remarks.append(
                f"its numbers fold back {limit:.1f} deg off the axis, inside the image: the field"
                " of view ends there"
            )
    return lens, FitReport("kb4", remarks=tuple(remarks))


def _fitted(
    model: str, values: Values, size: tuple[int, int], fov: float | None
) -> tuple[FisheyeParams, FitReport]:
    """Fit our lens; ocam's polynomial is told how far the image reaches."""
    core = model.partition("-")[0]
    if core not in (*DENOMINATORS, *ANGULAR):
        raise ValueError(f"camera model {model!r} is not known")
    if core == "ocam":
        corner = (
            max(values["cx"], size[0] - values["cx"]),
            max(values["cy"], size[1] - values["cy"]),
        )
        values = values | {"farthest": 1.1 * math.hypot(*corner)}
        if (
            not values["a0"] < 0.0
            or values["fx"] * values["fy"] == values["skew"] * values["shear"]
        ):
            raise ValueError(f"direct polynomial begins with {values['a0']:g}; expected below 0")
    return fit_fisheye(model, values, *size, fov)


def _contradictions(
    model: str, values: Values, size: tuple[int, int], labelled: bool
) -> tuple[str, list[str]]:
    """The model that a file's numbers are of, and what they say against their label."""
    names = values.keys() & set(["k1", "k2", "k3", "k4", "p1", "p2", "k5", "k6", "w"])
    remarks = []
    if names and not any(values[k] for k in names):
        focal = (
            "; its focal length is the image's width over pi"
            if math.isclose(values["fx"], size[0] / math.pi, rel_tol=1e-4)
            else ""
        )
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
