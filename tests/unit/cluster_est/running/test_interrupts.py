"""An interrupt ends a run only where it waits, and leaves what was found so far."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time

import numpy as np
import pytest
from support.problems.functions import PROBLEMS, FunctionExecutor

from cluster_est.methods.base import Ending
from cluster_est.methods.least_squares.method import LeastSquares
from cluster_est.problem.search_space.space import make_space
from cluster_est.running.interrupts import DeferredInterrupts, later, stopped_by, terminations
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Status


def interrupt_here():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)


def wait_after_an_interrupt(interrupts):
    interrupt_here()
    assert interrupts.noted == 1
    with interrupts.waiting():
        pytest.fail("an interrupt that was noted before must come at once")


def interrupt_in_vain():
    with contextlib.suppress(KeyboardInterrupt):
        interrupt_here()


def insist():
    for _ in range(3):
        interrupt_here()


class TestInterrupts:
    def test_is_noted_at_work_and_raised_when_it_waits(self):
        with pytest.raises(KeyboardInterrupt), DeferredInterrupts() as interrupts:
            wait_after_an_interrupt(interrupts)

    def test_is_not_lost_where_nothing_can_be_raised(self):
        with (
            pytest.raises(KeyboardInterrupt),
            DeferredInterrupts() as interrupts,
            interrupts.waiting(),
        ):
            interrupt_in_vain()

    def test_is_not_lost_where_nothing_waits_any_more(self):
        with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
            interrupt_here()

    def test_comes_at_once_while_it_waits(self):
        with (
            pytest.raises(KeyboardInterrupt),
            DeferredInterrupts() as interrupts,
            interrupts.waiting(),
        ):
            interrupt_here()

    def test_whoever_insists_is_heard_anywhere(self):
        with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
            insist()

    def test_leaves_the_handlers_as_they_were(self):
        before = signal.getsignal(signal.SIGINT)
        with DeferredInterrupts():
            assert signal.getsignal(signal.SIGINT) is not before
        assert signal.getsignal(signal.SIGINT) is before

    def test_leaves_handlers_of_others_alone(self):
        noted = []
        before = signal.signal(signal.SIGINT, lambda number, frame: noted.append(number))
        try:
            with DeferredInterrupts() as interrupts, interrupts.waiting():
                interrupt_here()
        finally:
            signal.signal(signal.SIGINT, before)
        assert noted == [signal.SIGINT]

    def test_does_nothing_in_other_threads(self):
        raised = []

        def work():
            try:
                with DeferredInterrupts() as interrupts, interrupts.waiting():
                    pass
            except BaseException as error:
                raised.append(error)

        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
        assert raised == []

    def test_one_that_a_library_swallowed_is_not_lost(self):
        with terminations():
            interrupt_in_vain()
            with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
                pass

    def test_a_termination_is_one(self):
        with terminations(), pytest.raises(KeyboardInterrupt), DeferredInterrupts():
            terminate_here()


def terminate_here():
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)


def touch_and_wait(path):
    path.touch()
    threading.Event().wait(20.0)


class TestFromOutside:
    def test_a_stop_file_interrupts_a_wait(self, tmp_path):
        path = tmp_path / "stop"
        with pytest.raises(KeyboardInterrupt), stopped_by(path):
            touch_and_wait(path)
        assert not path.exists()

    def test_a_stop_file_of_an_earlier_run_stops_nothing(self, tmp_path):
        path = tmp_path / "stop"
        path.touch()
        with stopped_by(path):
            assert not path.exists()

    def test_what_takes_too_long_is_interrupted(self):
        with pytest.raises(KeyboardInterrupt), later(0.05):
            threading.Event().wait(20.0)

    def test_what_is_in_time_is_not(self):
        with later(0.05):
            pass
        time.sleep(0.1)


class Interrupting(FunctionExecutor):
    """Interrupts instead of some of its answers."""

    def __init__(self, residuals, at):
        super().__init__(residuals)
        self.calls, self._at = 0, at

    def completed(self):
        self.calls += 1
        if self.calls in self._at:
            raise KeyboardInterrupt
        return super().completed()


class TestRunner:
    def runner(self, *at, whole=False):
        problem = PROBLEMS[0]
        executor = Interrupting(problem.residuals, at)
        space = make_space(problem.problem(), (0,))
        return Runner(executor, whole=whole), SearchRequest("test", LeastSquares(), space)

    def test_searches_end_with_their_best_points(self):
        runner, request = self.runner(9)
        (solution,) = runner.run([request])
        assert solution.ending is Ending.INTERRUPTED
        assert runner.interrupted
        assert 0.0 < solution.cost < 24.2

    def test_an_interrupt_after_one_of_several_ended_is_not_lost(self):
        runner, request = self.runner(40)
        short = SearchRequest("short", LeastSquares(max_iterations=1), request.space)
        first, second = runner.run([short, request])
        assert first.ending is Ending.MAX_ITERATIONS
        assert second.ending in (Ending.INTERRUPTED, Ending.CONVERGED, Ending.PERFECT)
        runner, request = self.runner(8)
        first, second = runner.run([short, request])
        assert second.ending is Ending.INTERRUPTED
        assert runner.interrupted

    def test_no_search_begins_after_one(self):
        runner, request = self.runner(5)
        runner.run([request])
        calls = runner._executor.calls
        (solution,) = runner.run([request])
        assert solution.ending is Ending.INTERRUPTED
        assert runner._executor.calls == calls

    def test_a_recipe_of_many_steps_is_ended(self):
        runner, request = self.runner(5, whole=True)
        with pytest.raises(KeyboardInterrupt):
            runner.run([request])
        assert runner.interrupted

    def test_simulations_that_did_not_run_say_so(self):
        runner, _ = self.runner(1)
        outcomes = runner.simulate(np.array([[1.0, 1.0]]), (0,), "residuals", "after")
        assert [o.status for o in outcomes] == [Status.NOT_RUN]
        assert runner.interrupted
