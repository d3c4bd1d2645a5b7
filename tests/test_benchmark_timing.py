"""Timing of functions in turns, and ratios of their times."""

from benchmark.speed.timing import interleaved, ratio, summary, timed


def test_turns_rotate_and_the_burn_in_is_not_timed():
    calls = []
    runs = {name: lambda name=name: calls.append(name) for name in "abc"}
    seconds = interleaved(runs, rounds=3, burn_in=1)
    assert "".join(calls) == "abc" + "bca" + "cab" + "abc"
    assert {name: len(times) for name, times in seconds.items()} == {"a": 3, "b": 3, "c": 3}


def test_seconds_are_those_of_the_call_and_in_the_order_of_the_rounds(monkeypatch):
    clock, durations = [0.0], iter([9.0, 9.0, 1.0, 20.0, 40.0, 2.0])

    def run():
        clock[0] += next(durations)

    monkeypatch.setattr("time.perf_counter", lambda: clock[0])
    # Rounds: a b (burn-in), b a, a b
    assert interleaved({"a": run, "b": run}, rounds=2) == {"a": [20.0, 40.0], "b": [1.0, 2.0]}
    assert timed(lambda: None) == 0.0


def test_nothing_to_time_is_no_error():
    assert interleaved({}, rounds=2) == {}


def test_ratio_is_within_rounds():
    # A slow first round hits both alike; the ratio of the medians would be 1.5
    assert ratio([100.0, 2.0, 3.0], [50.0, 1.0, 2.0]) == 2.0
    assert summary([4.0, 1.0, 2.0, 3.0, 5.0]) == {"median": 3.0, "lower": 2.0, "upper": 4.0, "all": [4.0, 1.0, 2.0, 3.0, 5.0]}
