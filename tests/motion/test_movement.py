"""Figures of a movement against the formulas they come from."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from egopose.motion.movement import SHORTEST, Flight, asymmetry, flights, foot_contacts, landings, steps

RATE, GRAVITY = 240.0, 9.81


def throw(speed: float, before: int = 30, forward: float = 0.0, height: float = 1.0) -> tuple[np.ndarray, ...]:
    """``touching, com, com_velocity``: a point is thrown up from ``height`` and stands again where it came from."""
    air = max(2, round(2 * speed / GRAVITY * RATE))
    t = np.clip(np.arange(-before, air + before) / RATE, 0.0, air / RATE)
    com = np.stack([forward * t, 0 * t, height + speed * t - 0.5 * GRAVITY * t**2], axis=1)
    touching = np.ones(len(t), bool)
    touching[before : before + air] = False
    velocity = np.stack([0 * t + forward, 0 * t, speed - GRAVITY * t], axis=1)
    return touching, com, velocity


@given(speed=st.floats(0.5, 5.0), forward=st.floats(0.0, 8.0), stands=st.floats(0.7, 1.1))
def test_a_ballistic_flight(speed: float, forward: float, stands: float) -> None:
    touching, com, velocity = throw(speed, forward=forward)
    (flight,) = flights(touching, com, velocity, np.full(len(com), stands), RATE, GRAVITY)
    assert flight.time == pytest.approx(2 * speed / GRAVITY, abs=0.51 / RATE)
    assert flight.rise == pytest.approx(speed**2 / (2 * GRAVITY), abs=1e-4)
    assert flight.rise == pytest.approx(flight.rise_by_time, abs=0.01)
    assert flight.rise_by_time == pytest.approx(GRAVITY * flight.time**2 / 8)
    assert flight.rise_standing == pytest.approx(flight.rise + 1.0 - stands)
    assert flight.distance == pytest.approx(forward * flight.time)
    assert flight.drop == pytest.approx(0.0, abs=0.02)
    assert flight.take_off_speed == pytest.approx(speed)
    assert (flight.begin, flight.end) == (30, 30 + round(flight.time * RATE))


def test_a_body_that_falls_off_an_edge() -> None:
    t = np.arange(60) / RATE
    com = np.stack([1.5 * t, 0 * t, 1.0 - 0.5 * GRAVITY * np.clip(t - 10 / RATE, 0, None) ** 2], axis=1)
    touching = np.zeros(60, bool)
    touching[:10], touching[50:] = True, True
    (flight,) = flights(touching, com, np.gradient(com, axis=0) * RATE, np.ones(60), RATE, GRAVITY)
    assert flight.rise == pytest.approx(0.0, abs=1e-3)
    assert flight.drop == pytest.approx(0.5 * GRAVITY * (40 / RATE) ** 2, rel=1e-6)


def test_bounces_and_flights_that_the_clip_cuts_are_none() -> None:
    com = np.ones((120, 3))
    touching = np.ones(120, bool)
    touching[:20], touching[50 : 50 + round(0.5 * SHORTEST * RATE)], touching[100:] = False, False, False
    assert flights(touching, com, com, np.ones(120), RATE) == []
    touching[20:100] = False
    touching[60:62] = True  # a graze in the air
    touching[:10], touching[110:] = True, True
    assert [(f.begin, f.end) for f in flights(touching, com, com, np.ones(120), RATE)] == [(10, 110)]


def flight_of(begin: int, end: int) -> Flight:
    return Flight(begin, end, (end - begin) / RATE, 0, 0, 0, 0, 0, 0)


@given(rise=st.integers(1, 60), peak=st.floats(1.0, 10.0))
def test_the_load_rate_is_the_slope_up_to_the_peak(rise: int, peak: float) -> None:
    force = np.ones(400)
    force[50:150] = 0.0
    force[150 : 150 + rise] = peak * np.arange(1, rise + 1) / rise
    (landing,) = landings([flight_of(50, 150)], force, RATE)
    assert landing.begin == 150
    assert landing.peak == pytest.approx(peak)
    assert landing.load_rate == pytest.approx(peak / (rise / RATE))


def test_a_landing_ends_with_the_next_flight() -> None:
    force = np.ones(400)
    force[200:210], force[300:302] = 3.0, 9.0
    found = landings([flight_of(100, 200), flight_of(240, 300)], force, RATE)
    assert [landing.peak for landing in found] == [3.0, 9.0]
    assert landings([flight_of(390, 399)], force, RATE)[0].peak == 1.0


@given(period=st.integers(30, 120), stride=st.floats(0.2, 1.0), heading=st.floats(-3.0, 3.0), width=st.floats(0, 0.3))
def test_a_walk_of_even_steps(period: int, stride: float, heading: float, width: float) -> None:
    """Feet strike in turn, ``period`` samples and ``stride`` m apart; the body goes along ``heading``."""
    count = 6 * period
    n = np.arange(count)
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    across = np.array([-np.sin(heading), np.cos(heading), 0.0])
    com = (n / period * stride)[:, None] * along + [0, 0, 1.0]
    strikes = {0: [1, 3, 5], 1: [2, 4]}
    touching = np.zeros((count, 2), bool)
    feet = np.zeros((count, 2, 3))
    for foot, numbers in strikes.items():
        for number in numbers:
            begin = number * period
            touching[begin : begin + round(1.3 * period), foot] = True
            feet[begin : begin + 2 * period, foot] = number * stride * along + (foot - 0.5) * width * across
    contacts = foot_contacts(touching, touching.astype(float), RATE)
    found = steps(contacts, feet, com, [], RATE)
    assert [step.side for step in found] == ["left", "right", "left", "right"]
    for step in found:
        assert step.length == pytest.approx(stride)
        assert step.time == pytest.approx(period / RATE)
        assert not step.flight
    whole = [contact for contact in contacts if contact.whole]
    assert [contact.time for contact in whole] == pytest.approx([round(1.3 * period) / RATE] * len(whole))
    assert len(whole) == 4
    running = steps(contacts, feet, com, [flight_of(period + 5, period + 9)], RATE)
    assert [step.flight for step in running] == [True, False, False, False]


def test_a_body_on_the_spot_makes_no_steps() -> None:
    touching = np.zeros((400, 2), bool)
    touching[100:150, 0], touching[160:200, 1] = True, True
    contacts = foot_contacts(touching, 0.5 * touching, RATE)
    assert [contact.side for contact in contacts] == ["right", "left"]
    assert contacts[0].peak == 0.5
    assert steps(contacts, np.zeros((400, 2, 3)), np.zeros((400, 3)), [], RATE) == []


def test_hops_on_both_feet_are_no_steps() -> None:
    touching = np.zeros((400, 2), bool)
    for begin in (50, 150, 250):
        touching[begin : begin + 60, 0], touching[begin + 3 : begin + 60, 1] = True, True
    com = np.linspace(0, 3, 400)[:, None] * [1.0, 0, 0]
    contacts = foot_contacts(touching, 0.5 * touching, RATE)
    assert len(contacts) == 6
    assert steps(contacts, np.zeros((400, 2, 3)), com, [], RATE) == []


@given(right=st.floats(0, 1e4), left=st.floats(0, 1e4))
def test_asymmetry_is_bounded_and_turns_with_the_sides(right: float, left: float) -> None:
    value = asymmetry(right, left)
    if right + left < 1e-300:
        assert np.isnan(value) or abs(value) <= 200.0 + 1e-6
    else:
        assert abs(value) <= 200.0 + 1e-6
        assert asymmetry(left, right) == pytest.approx(-value)


def test_asymmetry_of_a_half() -> None:
    assert asymmetry(3.0, 1.0) == 100.0
    assert np.isnan(asymmetry(0.0, 0.0))
