"""Effects: possible differences between reality and the simulator, as changes of a setting.

An effect's equation is implemented in the block of :mod:`sim` that it extends, or in
:mod:`sim.kernels.replay.sampling`. Its table in ``configs/effects`` only lists the numbers of a
:class:`sim.effects.setting.Setting` that it changes."""

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
    """A way in which reality may differ from the model.

    The size theta is a *deviation* from the model: 0 means that the model is correct.
    """

    name: str  # identifier, such as rope_length
    cause: str  # in words, as the first half of a sentence
    equation: str  # the change of the model, with theta
    unit: str  # of theta
    block: str  # block of the simulator that holds the equation, such as rope, motor, sensing
    bounds: tuple[float, float]  # physically possible values of theta
    prior_sd: Positive  # standard deviation of theta if the effect is present
    # negligible size: numerical error, and 5 mm of landing or a tenth of the noise; the diagnosis
    # of throws computes how far a size moves landings
    floor: Positive
    channels: tuple[str, ...]  # channels of the log that are required to estimate it
    source: str  # of equation and prior
    manoeuvres: tuple[str, ...] = ()  # manoeuvres that separate it from similar effects
    # group of effects whose differences are smaller than the errors of their equations
    alike: str = ""
    # another kind of block, which replaces the present one if theta is 1 (not 0); derivatives with
    # respect to such a theta are of little use
    switch: str = ""


@dataclass(frozen=True)
class Change(BoundedFields):
    """A number of a setting that an effect changes."""

    path: str  # such as plant.vehicle.thrust.gain
    index: int | None = None  # element of a tuple; None: all elements
    scale: bool = False  # multiply by (1 + factor theta) instead of adding factor theta
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
    """Raise ValueError if a setting has no number at this path. Paths in the camera are not
    checked, because the simulator does not define them.
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
    """A lower bound of theta that limits the decrease of a number of the setting.

    At the bound, the number is ``(1 - share) * number + factor * least``.
    """

    path: str  # of the number
    share: float = 1.0  # share of the number by which theta may reduce it
    factor: float = 1.0  # change of the number for each unit of theta
    least: float = 0.0  # added to the bound [unit of theta]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_path(self.path)


@dataclass(frozen=True)
class SettingEffect(Effect):
    """An effect that changes a setting; a table of ``configs/effects``.

    Raises ValueError: an unknown condition or switch, or neither or both of changes and switch."""

    changes: tuple[Change, ...] = ()
    step: Positive = 0.25  # of theta for derivatives, in floors
    needs: str = "always"  # condition on the setting, a name of sim.effects.blocks.CONDITIONS
    # whether it switches to a simpler block: only on request, because it compiles another kernel
    simpler: bool = False
    # whether it is specific to the recorded flights and not written to the vehicle's configuration
    transient: bool = False
    lowest: tuple[Lowest, ...] = ()  # additional bounds: no negative mass, delay or drag

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
        """Return whether a setting has the blocks and numbers that the effect changes."""
        return CONDITIONS[self.needs](setting)

    def apply(self, setting: Setting, theta: float) -> Setting:
        """Return the setting in which the effect has the size ``theta``."""
        if self.switch:
            return SWITCHES[self.switch](setting) if theta > 0.5 else setting
        for change in self.changes:
            setting = change.apply(setting, theta)
        return setting

    def bound_by(self, setting: Setting) -> "SettingEffect":
        """Return the effect with its lower bound raised to the limits of this setting's numbers."""
        if not self.lowest:
            return self
        low, high = self.bounds
        for x in self.lowest:
            low = max(low, x.least - x.share * _read(setting, x.path) / x.factor)
        return dataclasses.replace(self, bounds=(low, high))


@dataclass(frozen=True)
class RandomEffect(BoundedFields):
    """A quantity that varies between flights with a normal distribution about its mean."""

    name: str
    cause: str  # in words, as the first half of a sentence
    equation: str  # with theta, the standard deviation
    of: tuple[str, ...]  # effects that vary, all with the same standard deviation
    unit: str
    block: str
    prior_sd: Positive  # of the half-normal prior of theta if the quantity varies
    floor: Positive
    source: str
    manoeuvres: tuple[str, ...] = ()


@dataclass(frozen=True)
class EffectTables:
    """Schema of a file of ``configs/effects``: name -> effect."""

    effects: dict[str, SettingEffect] = field(default_factory=dict)
    random_effects: dict[str, RandomEffect] = field(default_factory=dict)


def apply(
    effects: Mapping[str, SettingEffect], setting: Setting, theta: Mapping[str, float]
) -> Setting:
    """Apply effects of the sizes ``theta`` to a setting, in the order of ``effects``.

    Raises KeyError: an unknown effect."""
    if unknown := theta.keys() - effects.keys():
        raise KeyError(*unknown)
    for name, effect in effects.items():
        if size := theta.get(name, 0.0):
            setting = effect.apply(setting, size)
    return setting


def possible_together(
    effects: Mapping[str, SettingEffect], setting: Setting, theta: Mapping[str, float]
) -> dict[str, float]:
    """Raise sizes to the lower bounds that remain after the effects before them are applied.

    The bounds of an effect assume that it acts alone. Two effects within their bounds that reduce
    the same number could together make it negative. ``theta``: sizes within the bounds, to be
    applied by :func:`apply`. Returns the sizes that differ from 0.
    """
    sizes = {}
    for name, effect in effects.items():
        if size := theta.get(name, 0.0):
            sizes[name] = max(size, effect.bound_by(setting).bounds[0])
            setting = effect.apply(setting, sizes[name])
    return sizes
