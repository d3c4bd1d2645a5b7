"""Values and attributes as plain data, and back."""

import re
from collections import Counter, OrderedDict, defaultdict, deque
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from environment_states import assert_plain, assert_same
from gymnasium.wrappers.utils import RunningMeanStd as GymnasiumRunningMeanStd
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy
from stable_baselines3.common.running_mean_std import RunningMeanStd

from sb3_cgp.resumption.plain_data import NotPlainError, equal, from_plain, plain_attributes, set_plain_attributes, to_plain

KEYS = st.none() | st.booleans() | st.integers() | st.text() | st.just("__type__") | st.tuples(st.integers(), st.binary())
NUMBERS = st_numpy.boolean_dtypes() | st_numpy.integer_dtypes() | st_numpy.floating_dtypes() | st_numpy.complex_number_dtypes()
ARRAYS = NUMBERS.flatmap(lambda dtype: st_numpy.arrays(dtype, st_numpy.array_shapes(min_dims=0, min_side=0, max_side=3)))
VALUES = st.recursive(
    st.floats() | KEYS | ARRAYS | ARRAYS.map(np.transpose) | NUMBERS.flatmap(st_numpy.from_dtype),
    lambda inside: st.one_of(
        st.lists(inside, max_size=3),
        st.lists(inside, max_size=3).map(tuple),
        st.dictionaries(KEYS, inside, max_size=3),
        st.dictionaries(KEYS, inside, max_size=3).map(OrderedDict),
        st.builds(deque, st.lists(inside, max_size=3), st.none() | st.integers(3, 5)),
    ),
    max_leaves=8,
)


@given(VALUES)
def test_values_make_the_round_trip(value):
    plain = to_plain(value)
    assert_plain(plain)
    assert_same(from_plain(plain), value)


@pytest.mark.parametrize(
    "value",
    [
        *(deque([1], 4), {1, 2}, frozenset({"a"}), {0: [{}]}, OrderedDict(a=1)),
        *(Counter("abca"), Counter({2: 0, "a": -1}), defaultdict(list, {3: [1]}), defaultdict(deque, a=deque([1], 2))),
    ],
)
def test_collections_keep_their_kind(value):
    again = from_plain(to_plain(value))
    assert type(again) is type(value)
    assert again == value
    for name in ("maxlen", "default_factory"):
        assert getattr(again, name, None) == getattr(value, name, None)


@pytest.mark.parametrize("kind", [set, frozenset])
def test_the_order_of_a_set_does_not_count(kind):
    """Python gives strings another order in each process."""
    first, second = ({"__type__": kind.__name__, "items": [*items]} for items in ("abc", "cab"))
    assert equal(first, second)
    assert equal({"nested": [first]}, {"nested": [second]})
    assert not equal(first, {"__type__": kind.__name__, "items": ["a", "b"]})
    assert equal(to_plain(kind([np.nan])), to_plain(kind([float("nan")])))
    assert not equal(first, {"__type__": "deque", "items": ["a", "b", "c"], "maxlen": None})
    # That of others does
    queues = [{"__type__": "deque", "items": [*items], "maxlen": None} for items in ("abc", "cab")]
    assert not equal(*queues)


@pytest.mark.parametrize(
    "value",
    [
        object(),
        np.array([None]),
        np.array(["a"]),
        np.datetime64("2020-01-01"),
        np.ma.masked_array([1]),
        np.zeros(2, "i4,f4"),
        np.random.RandomState(),
        SimpleNamespace(),
        len,
        defaultdict(lambda: 0),
        type("Integer", (int,), {})(1),
        type("Mapping", (dict,), {})(),
    ],
)
def test_other_values_are_left_out(value):
    for each in (value, [value], {"key": (value,)}):
        with pytest.raises(NotPlainError):
            to_plain(each)
    assert plain_attributes(SimpleNamespace(value=value, held=[value], other=1)) == {"other": 1}


def test_attributes_are_copied_there_and_back():
    itself = []
    itself.append(itself)
    source = SimpleNamespace(values=np.arange(3.0), held=[np.zeros(2)], itself=itself, model=1)
    state = plain_attributes(source, without=("model",))
    assert list(state) == ["values", "held"]
    target = SimpleNamespace(values=None, kept=1)
    set_plain_attributes(target, state)
    for changed in (source, target):
        changed.values += 1.0
        changed.held[0] += 1.0
    assert_same(state, {"values": np.arange(3.0), "held": [np.zeros(2)]})
    assert target.kept == 1
    assert not hasattr(target, "model")


def test_arrays_keep_their_layout():
    values = np.asfortranarray(np.random.default_rng(1).normal(size=(5, 7)))
    plain = to_plain(values)
    assert plain.strides == from_plain(plain).strides == values.strides


def test_attributes_go_past_setattr():
    class Redirects:
        def __setattr__(self, name, value):
            pytest.fail("was set elsewhere")

    obj = Redirects()
    set_plain_attributes(obj, {"value": 1})
    assert vars(obj) == {"value": 1}


@pytest.mark.parametrize("kind", ["MT19937", "PCG64", "PCG64DXSM", "Philox", "SFC64"])
def test_generators_that_are_shared_still_are(kind):
    make = getattr(np.random, kind)
    source = SimpleNamespace(generator=np.random.Generator(make(1)))
    source.generator.integers(10, dtype=np.uint32)
    state = plain_attributes(source)
    assert_plain(state)
    expected = source.generator.normal(size=7)
    shared = np.random.Generator(make(2))
    targets = [SimpleNamespace(generator=shared), SimpleNamespace(generator=shared)]
    for target in targets:
        set_plain_attributes(target, state)
    assert targets[0].generator is targets[1].generator is shared
    assert_same(shared.normal(size=7), expected)
    other = np.random.MT19937 if kind != "MT19937" else np.random.PCG64
    for there in (None, np.random.Generator(other(3))):
        target = SimpleNamespace(generator=there)
        set_plain_attributes(target, state)
        assert_same(target.generator.normal(size=7), expected)


@pytest.mark.parametrize("kind", [RunningMeanStd, GymnasiumRunningMeanStd])
def test_running_statistics_make_the_round_trip(kind):
    statistics, batches = kind(shape=(2,)), np.random.default_rng(1).normal(size=(3, 4, 2))
    statistics.update(batches[0])
    source = SimpleNamespace(statistics={"key": statistics})
    state = plain_attributes(source)
    assert_plain(state)
    there = kind(shape=(2,))
    targets = [SimpleNamespace(statistics={"key": there}), SimpleNamespace(statistics=None)]
    for target in targets:
        set_plain_attributes(target, state)
    assert targets[0].statistics["key"] is there
    for each in (source, *targets):
        for batch in batches[1:]:
            each.statistics["key"].update(batch)
    for one, other in pairwise((source, *targets)):
        assert type(one.statistics["key"]) is kind
        assert_same(vars(one.statistics["key"]), vars(other.statistics["key"]))


@pytest.mark.parametrize(
    ("plain", "message"),
    [
        ({"__type__": "os.system"}, "`__type__` is 'os.system', but must be one of dict"),
        ({"__type__": "Generator", "state": {"bit_generator": "Popen"}}, "`bit_generator` is 'Popen', but must be one of"),
    ],
)
def test_unknown_types_are_refused(plain, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        set_plain_attributes(SimpleNamespace(), {"value": plain})
