"""Every scene of the gallery: its texts, and the ends of those that end; what they print is `test_scene_pages`'s."""

import pytest
from gallery_numbers import ENDS, quoted

import servoctl as sv
from servoctl.gallery import gallery

# --- the end of those that end


@pytest.mark.parametrize("name", ENDS)
def test_a_scene_ends_when_its_number_says(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    with pytest.raises(sv.errors.SingularProgram) as caught:
        sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)
    assert caught.value.details["t"] == pytest.approx(ENDS[name], rel=2e-5)
    assert quoted(name, ENDS[name])


# --- texts


@pytest.mark.parametrize("name", gallery)
def test_a_scene_says_what_it_teaches_and_where_it_comes_from(name):
    scene = gallery[name]
    for sentence in (scene.description, scene.teaches, scene.number):
        assert sentence[0].isupper() and sentence.endswith(".") and len(sentence) < 115
    assert scene.source and not scene.source.endswith(".") and 2 <= len(scene.group.split()) <= 3


def test_scenes_of_one_group_are_together():
    groups = [scene.group for scene in gallery.values()]
    assert [g for g, before in zip(groups, [None, *groups], strict=False) if g != before] == list(dict.fromkeys(groups))


@pytest.mark.parametrize("name", gallery)
def test_a_scene_has_the_units_of_its_signals(name):
    mechanism, _ = gallery[name].build()
    assert set(mechanism.units) >= {*mechanism.q.names, *mechanism.actuators, *mechanism.outputs}
