"""Settings under their former names, as run directories of earlier versions hold them."""

from __future__ import annotations

import pytest

from egopose.core.config import compose_config
from egopose.core.errors import InputError
from egopose.core.former_names import RENAMED, upgraded


def test_every_former_name_of_a_run_is_one_of_todays() -> None:
    for old, new in RENAMED.items():
        group, _, rest = old.partition(".")
        if group not in ("collector", "training", "data", "regressor"):
            continue
        nested: dict = {}
        inner = nested.setdefault(group, {})
        *path, last = rest.split(".")
        for part in path:
            inner = inner.setdefault(part, {})
        inner[last] = 7
        told = upgraded(nested)
        for part in new.split("."):
            told = told[part]
        assert told == 7, old


def test_present_names_stay_and_the_original_is_left_alone() -> None:
    config = compose_config("train")
    assert upgraded(config) == config
    old = {"collector": {"worlds": 3, "kind": "sync"}, "training": {"evaluate_async": True}}
    assert upgraded(old) == {"collector": {"num_envs": 3, "kind": "sync"}, "training": {}}
    assert old["collector"] == {"worlds": 3, "kind": "sync"}


def test_the_estimator_of_body_parts_has_its_new_name_too() -> None:
    assert upgraded({"regressor": {"kernel": {"limbs": "limbs"}}}) == {
        "regressor": {"kernel": {"body_parts": "body_parts"}}
    }
    assert upgraded({"regressor": {"kernel": None}}) == {"regressor": {"kernel": None}}


def test_a_former_name_on_the_command_line_is_told_the_present_one() -> None:
    with pytest.raises(InputError, match=r"collector\.worlds: is now called collector\.num_envs"):
        compose_config("train", ["collector.worlds=3"])
