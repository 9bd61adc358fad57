"""Effects: what reality may have and the simulator lacks, and what each changes in the description
of a simulated flight.

The equation of an effect stands in the block of :mod:`sim` that it extends (or in
:mod:`sim.kernels.replay.sampling`); its table in ``configs/effects`` names the numbers of a
:class:`sim.effects.setting.Setting` that it changes, nothing more."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, get_type_hints

from camera.field_bounds import BoundedFields, Positive
from sim.effects.blocks import CONDITIONS, SWITCHES
from sim.effects.setting import Setting
from sim.params import change_values


@dataclass(frozen=True)
class Effect(BoundedFields):
    """One cause that reality may have and the model lacks, or has with another size.

    The size theta is a *deviation*: 0 means that the model is right as it stands.
    """

    name: str  # identifier, such as rope_length
    cause: str  # in words, as the first half of a sentence
    equation: str  # what it changes, with theta
    unit: str  # of theta
    block: str  # block of the simulator that holds the equation, such as rope, motor, sensing
    bounds: tuple[float, float]  # physically possible values of theta
    prior_sd: Positive  # spread of theta where the effect is present
    # size below which it does not matter: numerics, and 5 mm of landing or a tenth of the noise;
    # the diagnosis of throws says by how much a size moves landings
    floor: Positive
    channels: tuple[str, ...]  # channels of the log that it needs
    source: str  # of equation and prior
    manoeuvres: tuple[str, ...] = ()  # manoeuvres that separate it from similar effects
    # group of effects that differ from each other by less than their equations are exact
    alike: str = ""
    # where theta is 0 or 1: the other kind of block that 1 puts in, of which a derivative says
    # little
    switch: str = ""


@dataclass(frozen=True)
class Change(BoundedFields):
    """A number of a setting that an effect changes."""

    path: str  # such as plant.vehicle.thrust.gain
    index: int | None = None  # of a tuple; None: all of it
    scale: bool = False  # times (1 + factor theta) instead of plus factor theta
    factor: float = 1.0  # of theta

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_path(self.path)

    def apply(self, setting: Setting, theta: float) -> Setting:
        """Return the setting with this number changed."""
        value = _read(setting, self.path)
        if isinstance(value, tuple):
            picked = range(len(value)) if self.index is None else (self.index,)
            new: Any = tuple(self._new(v, theta) if i in picked else v for i, v in enumerate(value))
        else:
            new = self._new(value, theta)
        return change_values(setting, {self.path: new})

    def _new(self, value: float, theta: float) -> float:
        return value * (1.0 + self.factor * theta) if self.scale else value + self.factor * theta


def _check_path(path: str) -> None:
    """Raise ValueError for a number that no setting has; those of the camera, which the simulator
    knows nothing of, pass.
    """
    owner: Any = Setting
    for name in path.split("."):
        if owner is Any:
            return
        if not dataclasses.is_dataclass(owner):
            raise ValueError(f"path '{path}': a number before '{name}'; expected nothing after it")
        types = _field_types(owner)
        if name not in types:
            raise ValueError(f"path '{path}': no '{name}'; expected one of: {', '.join(types)}")
        owner = types[name]
    if dataclasses.is_dataclass(owner):
        names = ", ".join(_field_types(owner))
        raise ValueError(f"path '{path}': a group of numbers; expected one of it: {names}")


@cache
def _field_types(owner: type) -> dict[str, Any]:
    """Return the types of a dataclass's fields."""
    types = get_type_hints(owner)
    return {f.name: types[f.name] for f in dataclasses.fields(owner)}


def _read(setting: Any, path: str) -> Any:
    for name in path.split("."):
        setting = getattr(setting, name)
    return setting


@dataclass(frozen=True)
class Lowest(BoundedFields):
    """A lower bound of theta, such that a number of the setting, which theta changes, keeps a part.

    At the bound, ``(1 - share) * number + factor * least`` remains of the number.
    """

    path: str  # of the number
    share: float = 1.0  # part of the number that theta may take away
    factor: float = 1.0  # change of the number for each unit of theta
    least: float = 0.0  # size of theta whose change of the number remains besides [unit of theta]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_path(self.path)


@dataclass(frozen=True)
class SettingEffect(Effect):
    """An effect as a change of a setting; a table of ``configs/effects``.

    Raises ValueError: a condition or a kind of block that does not exist, or neither or both of
    changes and switch."""

    changes: tuple[Change, ...] = ()
    step: Positive = 0.25  # of theta for derivatives, in floors
    needs: str = "always"  # what the setting must have: a name of sim.effects.blocks.CONDITIONS
    # a switch to a simpler block: only on request, as each compiles a kernel
    simpler: bool = False
    # whether it is a state of these flights only, which no configuration of the vehicle takes over
    transient: bool = False
    lowest: tuple[Lowest, ...] = ()  # beside the bounds: no negative mass, delay or drag

    def __post_init__(self) -> None:
        super().__post_init__()
        for key, choices in (("needs", CONDITIONS), ("switch", {"": None, **SWITCHES})):
            name = getattr(self, key)
            if name not in choices:
                raise ValueError(
                    f"{key}: got '{name}'; expected one of: {', '.join(filter(None, choices))}"
                )
        if bool(self.changes) == bool(self.switch):
            raise ValueError("got both changes and a switch, or neither; expected one of them")

    def applies(self, setting: Setting) -> bool:
        """Tell whether a setting has what the effect changes."""
        return CONDITIONS[self.needs](setting)

    def apply(self, setting: Setting, theta: float) -> Setting:
        """Return the setting in which the effect has the size ``theta``."""
        if self.switch:
            return SWITCHES[self.switch](setting) if theta > 0.5 else setting
        for change in self.changes:
            setting = change.apply(setting, theta)
        return setting

    def bound_by(self, setting: Setting) -> "SettingEffect":
        """Return the effect with the lower bound that this setting's own numbers set."""
        if not self.lowest:
            return self
        low, high = self.bounds
        for x in self.lowest:
            low = max(low, x.least - x.share * _read(setting, x.path) / x.factor)
        return dataclasses.replace(self, bounds=(low, high))


@dataclass(frozen=True)
class RandomEffect(BoundedFields):
    """A quantity that is drawn anew in every flight, from a normal distribution about its mean."""

    name: str
    cause: str  # in words, as the first half of a sentence
    equation: str  # theta: the standard deviation
    of: tuple[str, ...]  # effects, in whose unit it is; of several one deviation for all
    unit: str
    block: str
    prior_sd: Positive  # of the half-normal deviation, where the quantity varies
    floor: Positive
    source: str
    manoeuvres: tuple[str, ...] = ()


@dataclass(frozen=True)
class EffectTables:
    """A file of ``configs/effects``: name -> what bears it."""

    effects: dict[str, SettingEffect] = field(default_factory=dict)
    random_effects: dict[str, RandomEffect] = field(default_factory=dict)


def apply(
    effects: Mapping[str, SettingEffect], setting: Setting, theta: Mapping[str, float]
) -> Setting:
    """Return the setting with effects of these sizes, applied in the order of ``effects``.

    Raises KeyError: no effect of that name."""
    if unknown := theta.keys() - effects.keys():
        raise KeyError(*unknown)
    for name, effect in effects.items():
        if size := theta.get(name, 0.0):
            setting = effect.apply(setting, size)
    return setting


def possible_together(
    effects: Mapping[str, SettingEffect], setting: Setting, theta: Mapping[str, float]
) -> dict[str, float]:
    """Return the sizes that can be applied together: none takes more of a number than the effects
    before it leave.

    Bounds hold for an effect alone. Two that lower one number, each within its bounds, could make
    it negative. ``theta``: sizes within the bounds, of effects that :func:`apply` is to apply.
    """
    sizes = {}
    for name, effect in effects.items():
        if size := theta.get(name, 0.0):
            sizes[name] = max(size, effect.bound_by(setting).bounds[0])
            setting = effect.apply(setting, sizes[name])
    return sizes
