"""Claims on method options from text: right kinds, nested groups, one sentence for every mistake."""

from __future__ import annotations

import pytest

from semrecon.errors import InputError
from semrecon.method_options import has_option, parsed_settings, with_settings
from semrecon.methods import KnownRotation


def test_values_take_the_kind_of_the_option() -> None:
    method = with_settings(
        KnownRotation(),
        parsed_settings(["pairs=adjacent", "refine=true", "reject-sigmas=3", "refinement.rounds=7"]),
    )
    assert isinstance(method, KnownRotation)
    assert (method.pairs, method.refine, method.reject_sigmas, method.refinement.rounds) == ("adjacent", True, 3.0, 7)
    assert method.refinement.tilt_sigma_deg == KnownRotation().refinement.tilt_sigma_deg


def test_nothing_set_is_the_method_itself() -> None:
    assert with_settings(KnownRotation(), {}) == KnownRotation()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("refine", "NAME=VALUE"),
        ("=3", "NAME=VALUE"),
        ("speed=3", "no option 'speed'; its options are correspondence"),
        ("refine=3", "true or false"),
        ("refine=yes", "true or false"),
        ("reject_sigmas=many", "must be a number"),
        ("refinement.rounds=2.5", "whole number"),
        ("pairs=some", "'all' or 'adjacent', not 'some'"),
        ("refinement=3", "is a group: set refinement."),
        ("refine.deep=3", "no options of its own"),
        ("refinement.speed=3", "known_rotation.refinement has no option 'speed'"),
    ],
)
def test_a_mistake_is_one_sentence(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        with_settings(KnownRotation(), parsed_settings([text]))


def test_options_are_found_by_their_dotted_names() -> None:
    assert has_option(KnownRotation(), "refinement.tilt_sigma_deg")
    assert not has_option(KnownRotation(), "refinement.speed")
    assert not has_option(KnownRotation(), "refine.speed")
