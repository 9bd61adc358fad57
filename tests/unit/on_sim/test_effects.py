"""Effects on a plant's numbers, by numbers worked by hand."""

from dataclasses import replace
from itertools import combinations

from pytest import approx, mark, raises

from sim.effects.effect import Change, Lowest, apply, possible_together
from sim.effects.setting import Setting, generalise
from tests.plants import paper_plant
from visthrow.config.effects import catalogue

MASS = "plant.rope.payload_mass"


@mark.parametrize(("share", "factor", "least"), [(1.0, 1.0, 0.01), (0.5, 0.1, 0.2)])
def test_the_lower_bound_leaves_what_the_limit_says(share, factor, least):
    setting = Setting(paper_plant())
    mass = setting.plant.rope.payload_mass
    effect = next(e for e in catalogue().values() if e.lowest)
    limits = (Lowest(MASS, share, factor, least),)
    effect = replace(effect, bounds=(-9.0, 9.0), lowest=limits)
    low, high = effect.bound_by(setting).bounds
    assert high == 9.0
    assert mass + factor * low == approx((1.0 - share) * mass + factor * least)


def test_two_effects_together_keep_every_number_of_the_plant_within_its_bounds():
    setting = generalise(Setting(paper_plant()))
    effects = {
        name: effect.bound_by(setting)
        for name, effect in catalogue().items()
        if effect.changes and not effect.simpler and effect.applies(setting)
    }
    lowest = {name: effect.bounds[0] for name, effect in effects.items()}
    for pair in combinations(effects, 2):
        apply(effects, setting, possible_together(effects, setting, {n: lowest[n] for n in pair}))


def test_an_effect_takes_what_others_leave_of_a_number():
    setting = generalise(Setting(paper_plant()))
    names = "rotor_drag", "rotor_drag_z"
    effects = {name: catalogue()[name].bound_by(setting) for name in names}
    drag = setting.plant.vehicle.aero.drag_z
    sizes_together = {"rotor_drag_z": -0.75 * drag, "rotor_drag": -drag}
    with raises(ValueError, match="drag_z is -"):
        apply(effects, setting, sizes_together)
    sizes = possible_together(effects, setting, sizes_together)
    assert sizes == {"rotor_drag": -drag, "rotor_drag_z": approx(-0.5 * drag)}
    assert apply(effects, setting, sizes).plant.vehicle.aero.drag_z == approx(0.0, abs=1e-15)
    assert possible_together(effects, setting, {"rotor_drag_z": -drag}) == {"rotor_drag_z": -drag}


@mark.parametrize("kind", [Change, Lowest])
def test_a_path_leads_to_a_number(kind):
    with raises(ValueError, match=r"'plant\.rope': a group of numbers; .*length"):
        kind("plant.rope")
    with raises(ValueError, match="a number before 'x'"):
        kind("plant.rope.length.x")
    with raises(ValueError, match="no 'ropes'"):
        kind("plant.ropes")
    assert kind("plant.rope.length").path == "plant.rope.length"
