"""An interrupt ends a run only where it waits, and leaves what was found so far."""

import contextlib
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from support.problems.functions import ROSENBROCK
from support.shuffling_executor import ShufflingExecutor

from cluster_est.methods import LeastSquares
from cluster_est.methods.method import Ending
from cluster_est.running.interrupts import DeferredInterrupts, later, stopped_by, terminations
from cluster_est.running.runner import Runner
from cluster_est.running.search_state import SearchRequest
from workers.messages import Status


def interrupt_here(number=signal.SIGINT):
    os.kill(os.getpid(), number)
    time.sleep(0.01)


def interrupt_in_vain():
    """As in a callback from C, where nothing can be raised."""
    with contextlib.suppress(KeyboardInterrupt):
        interrupt_here()


def noted_at_work(interrupts):
    interrupt_here()
    assert interrupts.noted == 1


def noted_before_it_waits(interrupts):
    noted_at_work(interrupts)
    with interrupts.waiting():
        pytest.fail("an interrupt that was noted before must come at once")


def while_it_waits(interrupts):
    with interrupts.waiting():
        interrupt_here()
        pytest.fail("it must come at once")


def where_nothing_can_be_raised(interrupts):
    with interrupts.waiting():
        interrupt_in_vain()
    pytest.fail("it must come when the wait is over")


def insisting(interrupts):
    for _ in range(3):
        interrupt_here()
    pytest.fail("whoever insists must be heard anywhere")


class TestInterrupts:
    @pytest.mark.parametrize(
        "work",
        [
            noted_at_work,
            noted_before_it_waits,
            while_it_waits,
            where_nothing_can_be_raised,
            insisting,
        ],
        ids=lambda work: work.__name__,
    )
    def test_none_is_lost(self, work):
        with pytest.raises(KeyboardInterrupt), DeferredInterrupts() as interrupts:
            work(interrupts)

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
        def work():
            with DeferredInterrupts() as interrupts, interrupts.waiting():
                pass

        with ThreadPoolExecutor(1) as pool:
            pool.submit(work).result()

    @pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
    def test_a_batch_system_and_a_terminal_that_goes_interrupt_as_one_does(self, name):
        number = getattr(signal, name, None)
        if number is None:
            pytest.skip("there is no such signal here")
        before = signal.signal(number, signal.SIG_DFL)  # with nohup it is ignored
        raised = pytest.raises(KeyboardInterrupt)
        try:
            with raised, terminations(), DeferredInterrupts() as interrupts, interrupts.waiting():
                interrupt_here(number)
            assert signal.getsignal(number) is signal.SIG_DFL
        finally:
            signal.signal(number, before)

    @pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="there is no such signal here")
    def test_a_program_that_outlives_its_terminal_does(self):
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            with terminations():
                interrupt_here(signal.SIGHUP)
        finally:
            signal.signal(signal.SIGHUP, before)

    def test_one_that_a_library_swallowed_is_not_lost(self):
        with terminations():
            interrupt_in_vain()
            with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
                pass

    def test_what_one_has_left_half_made_goes_in_silence(self, capsys):
        class HalfMade:
            def __del__(self) -> None:
                raise AttributeError("it was not made")

        with terminations():
            with pytest.raises(KeyboardInterrupt), DeferredInterrupts():
                interrupt_here(signal.SIGINT)
            HalfMade()
        assert capsys.readouterr().err == ""


class TestFromOutside:
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


class TestRunner:
    def runner(self, call, whole=False):
        """One whose executor is interrupted at the first or a later call."""

        def before(number):
            if number == call:
                raise KeyboardInterrupt

        executor = ShufflingExecutor(ROSENBROCK.answer, before=before)
        request = SearchRequest("test", LeastSquares(), ROSENBROCK.space())
        return Runner(executor, whole=whole), request, executor

    def test_no_search_begins_after_one(self):
        runner, request, executor = self.runner(5)
        runner.run([request])
        calls = executor.calls
        (solution,) = runner.run([request])
        assert solution.ending is Ending.INTERRUPTED
        assert executor.calls == calls

    def test_a_recipe_of_many_steps_is_ended(self):
        runner, request, _ = self.runner(5, whole=True)
        with pytest.raises(KeyboardInterrupt):
            runner.run([request])
        assert runner.interrupted

    def test_simulations_that_did_not_run_say_so(self):
        runner, *_ = self.runner(0)
        outcomes = runner.simulate(np.array([[1.0, 1.0]]), (0,), "residuals", "after")
        assert [o.status for o in outcomes] == [Status.NOT_RUN]
        assert runner.interrupted
