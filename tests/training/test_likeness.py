"""Which photographs are matched: all of few, of many those that share what they show."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats.training.likeness import ALIKE, ALL_UP_TO, NEXT, alike_pairs, in_sequence

COUNT, LANDMARKS, WINDOW, STEP = 90, 900, 60, 10


def on_a_walk(order: np.ndarray) -> list[np.ndarray]:
    """Features of photographs on a round, of which each shows 60 of 900 landmarks, 10 on from the one before:
    the photograph at place ``order[k]`` of the round is the k-th by name."""
    rng = np.random.default_rng(0)
    landmarks = rng.random((LANDMARKS, 128))
    found = []
    for place in order:
        seen = landmarks[(STEP * place + np.arange(WINDOW)) % LANDMARKS]
        noisy = seen + 0.05 * rng.normal(size=seen.shape)
        noisy *= 512 / np.linalg.norm(noisy, axis=1, keepdims=True)
        found.append(np.clip(noisy, 0, 255).astype(np.uint8))
    return found


def test_few_photographs_are_all_matched():
    pairs = alike_pairs([np.zeros((3, 128), np.uint8)] * 5)
    assert pairs.tolist() == [[i, j] for i in range(5) for j in range(i + 1, 5)]
    assert len(alike_pairs([np.zeros((3, 128), np.uint8)] * ALL_UP_TO)) == ALL_UP_TO * (ALL_UP_TO - 1) // 2


def test_photographs_that_show_the_same_are_matched_whatever_their_names():
    order = np.random.default_rng(1).permutation(COUNT)
    pairs = alike_pairs(on_a_walk(order))
    assert (pairs[:, 0] < pairs[:, 1]).all()
    assert len(np.unique(pairs, axis=0)) == len(pairs) <= COUNT * (ALIKE + NEXT)
    chosen = {tuple(pair) for pair in pairs.tolist()}
    place = np.argsort(order)  # of each step of the round, among the names
    for k in range(COUNT):
        for ahead in (1, 2, 3, 4):  # a third of the landmarks is shared
            one, other = place[k], place[(k + ahead) % COUNT]
            assert (min(one, other), max(one, other)) in chosen


def test_photographs_that_follow_each_other_are_matched_though_unlike():
    order = np.random.default_rng(1).permutation(COUNT)
    features = on_a_walk(order)
    features[40] = np.zeros((0, 128), np.uint8)  # of a wall
    chosen = {tuple(pair) for pair in alike_pairs(features).tolist()}
    for k in range(COUNT - NEXT):
        assert {(k, k + step) for step in range(1, NEXT + 1)} <= chosen


def test_photographs_follow_each_other_as_they_are_counted():
    names = [
        "a10.jpg",
        "1.jpg",
        "10.jpg",
        "a2_b12.jpg",
        "a2.jpg",
        "2.jpg",
        "a2_b3.jpg",
        "B7.jpg",
        "002.jpg",
        "٣.jpg",
    ]
    expected = [
        "1.jpg",
        "2.jpg",
        "002.jpg",
        "10.jpg",
        "B7.jpg",
        "a2.jpg",
        "a2_b3.jpg",
        "a2_b12.jpg",
        "a10.jpg",
    ]
    assert in_sequence(names) == [*expected, "٣.jpg"]
    assert in_sequence([f"{i}.jpg" for i in range(120)][::-1]) == [f"{i}.jpg" for i in range(120)]


@pytest.mark.parametrize("count", [0, 1])
def test_photographs_with_hardly_a_feature_are_no_error(count):
    assert len(alike_pairs([np.zeros((count, 128), np.uint8)] * (ALL_UP_TO + 1))) > ALL_UP_TO
