"""What every executor promises. A new one joins by two lines in `OPENERS`."""

import os
import re
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
from support.problems.driven_spring import model_of
from support.truth.example_models import REFERENCES, sampled_experiment

from cluster_est import Parameter, Problem
from cluster_est.errors import ExecutorError
from cluster_est.executors import EXECUTORS, Executor, WorkerPool, executor_class
from cluster_est.running.reset_policy import open_with_reset
from cluster_est.running.resources import Resources
from workers.errors import ModelError
from workers.evaluate import Evaluator
from workers.messages import Experiment, Input, Model, Outcome, Output, Solver, Status, Task
from workers.wire import TaskBatch

OPENERS = {
    "local-1": ("local", 1),
    "local-3": ("local", 3),
    "processes-1": ("processes", 1),
    "processes-2": ("processes", 2),
    "ray-2": ("ray", 2),
}
SLOW = pytest.mark.slow

SPRING = model_of(Solver("dormand_prince"), ("m", "k"))
EXPERIMENTS: tuple[Experiment, ...] = tuple(
    sampled_experiment(REFERENCES["mass_spring_damper"], "linear", seed) for seed in range(4)
)


@dataclass(frozen=True)
class Setup:
    """An executor that is open, and how to open another one like it."""

    executor: Executor
    open: Callable[[Model, tuple[Experiment, ...]], Executor]


@pytest.fixture(scope="module")
def ray_started(cache_folder):
    """One Ray for all tests, with processors enough for two pools at the same time."""
    leave = executor_class("ray").join(4, "local")
    yield
    leave()


@pytest.fixture(scope="module")
def setup(request):
    name, workers = OPENERS[request.param]
    if name == "ray":
        request.getfixturevalue("ray_started")

    def open_one(model, experiments):
        return executor_class(name).open(model, experiments, workers, None)

    with open_one(SPRING, EXPERIMENTS) as executor:
        yield Setup(executor, open_one)


def on_executors(*seldom):
    """Each executor, some of them not by default: a pool of Ray takes seconds to open."""
    cases = [pytest.param(key, marks=SLOW if key in seldom else ()) for key in OPENERS]
    return pytest.mark.parametrize("setup", cases, indirect=True, scope="module")


EACH = on_executors("processes-1")
SELDOM_ON_RAY = on_executors("processes-1", "ray-2")


def make_tasks(count, want="residuals", first=0):
    """Tasks on all experiments in no order, some of which fail."""
    generator = np.random.default_rng(count)
    masses, stiffnesses = generator.uniform([[-0.2], [10.0]], [[3.0], [80.0]], (2, count))
    which = generator.integers(0, len(EXPERIMENTS), count)
    return [
        Task(first + i, int(which[i]), np.array([masses[i], stiffnesses[i]]), want)
        for i in range(count)
    ]


def long_tasks(count):
    """An experiment that takes some hundredths of a second, after the others, and many tasks."""
    times = np.linspace(0.0, 4_000.0, 40_001)
    inputs = (Input("F", times, np.sin(times)),)
    output = Output("y", times, np.zeros(len(times)))
    made = Experiment("long", 0.0, float(times[-1]), inputs, (output,))
    values = np.array([1.0, 30.0])
    return made, [Task(1000 + i, len(EXPERIMENTS), values) for i in range(count)]


def gather(executor, tasks):
    """Submit tasks and wait for an outcome of each; refuse any that comes twice."""
    executor.submit(tasks)
    outcomes: list[Outcome] = []
    while len(outcomes) < len(tasks):
        some = executor.completed()
        assert some, "nothing was completed although tasks are queued: wait for at least one"
        outcomes += some
    answered, asked = Counter(o.task for o in outcomes), Counter(t.id for t in tasks)
    assert answered == asked, "each task must be answered, and once"
    assert executor.completed() == [], "where nothing is queued, `completed` returns [] at once"
    return {outcome.task: outcome for outcome in outcomes}


def drain(executor, found):
    """Add all outcomes that are still to come."""
    while some := executor.completed():
        found += some


def check_nothing_is_left(executor):
    """What was asked twice may still be on its way, but it answers nothing any more."""
    deadline = time.monotonic() + 60.0
    while executor.busy and time.monotonic() < deadline:
        assert executor.completed() == [], "each task must be answered once"
        time.sleep(0.01)
    assert executor.completed() == [], "each task must be answered once"
    assert executor.busy == 0, "no worker is busy any more once everything is answered"


def same(outcome, expected):
    """Whether two outcomes agree in every bit that must not depend on where they come from."""
    facts = [
        (o.task, o.status, o.message, o.trajectory is None, *map(_bits, _arrays(o)))
        for o in (outcome, expected)
    ]
    return facts[0] == facts[1]


def _arrays(outcome):
    path = outcome.trajectory
    return outcome.residuals, path and path.times, path and path.values


def _bits(array):
    return array.tobytes() if isinstance(array, np.ndarray) else b""


def check(outcomes, tasks):
    """Compare with an evaluator's answers to the tasks, one at a time."""
    evaluator = Evaluator(SPRING, EXPERIMENTS, "reference")
    for task in tasks:
        (expected,) = evaluator.evaluate(TaskBatch.of([task]))
        assert same(outcomes[task.id], expected), (outcomes[task.id], expected)
    evaluator.close()


def test_every_executor_is_tested():
    assert {name for name, _ in OPENERS.values()} == set(EXECUTORS), (
        "add two lines to OPENERS, for one worker and for several"
    )


@pytest.mark.parametrize("name", EXECUTORS)
def test_an_executor_is_called_what_the_config_calls_it(name):
    assert executor_class(name).name == name, "EXECUTORS and the class name it differently"


def test_a_process_for_each_simulation_is_refused_where_there_is_but_this_one():
    parameters = tuple(Parameter(p, 1.0, (0.1, 100.0)) for p in SPRING.parameters)
    problem = Problem(replace(SPRING, reset="process"), parameters, EXPERIMENTS[:1])
    here = [name for name in EXECUTORS if executor_class(name).in_process]
    assert "local" in here
    for name in here:
        with pytest.raises(
            ExecutorError, match=rf'separate processes, but executor.name is "{name}"; set'
        ):
            open_with_reset(problem, Resources(executor=name))


class TestContract:
    @EACH
    def test_many_tasks_are_answered_once_each_and_bit_for_bit(self, setup):
        tasks = make_tasks(600)
        outcomes = gather(setup.executor, tasks)
        check(outcomes, tasks)
        failed = [o for o in outcomes.values() if not o.ok]
        assert 0 < len(failed) < len(tasks) / 2
        assert all(o.status is Status.SOLVER_FAILURE and "mass" in o.message for o in failed)

    @EACH
    def test_mixed_wants_are_answered_as_wanted(self, setup):
        tasks = make_tasks(30) + make_tasks(30, "trajectory", first=50)
        tasks = [tasks[i] for i in np.random.default_rng(0).permutation(len(tasks))]
        outcomes = gather(setup.executor, tasks)
        check(outcomes, tasks)
        for task in tasks:
            outcome = outcomes[task.id]
            assert (outcome.trajectory is not None) == (outcome.ok and task.want == "trajectory")

    @EACH
    def test_tasks_may_be_submitted_while_others_run(self, setup):
        tasks, found = make_tasks(90), []
        for some in (tasks[:30], tasks[30:60], tasks[60:]):
            setup.executor.submit(some)
            found += setup.executor.completed()
        drain(setup.executor, found)
        check({outcome.task: outcome for outcome in found}, tasks)

    @EACH
    def test_busy_counts_workers_and_nothing_submitted_is_nothing_completed(self, setup):
        setup.executor.submit([])
        check_nothing_is_left(setup.executor)
        tasks, found = make_tasks(20), []
        setup.executor.submit(tasks)
        assert 1 <= setup.executor.busy <= setup.executor.workers, (
            "`busy` counts the workers that have something to do, not the tasks"
        )
        drain(setup.executor, found)
        assert len(found) == len(tasks)
        check_nothing_is_left(setup.executor)

    @SELDOM_ON_RAY
    def test_what_has_not_begun_can_be_taken_back(self, setup):
        experiment, long = long_tasks(500)
        with setup.open(SPRING, (*EXPERIMENTS, experiment)) as executor:
            short = make_tasks(20)
            executor.submit([*short, *long])
            taken = executor.cancel({task.id for task in long})
            assert taken, (
                "so many long ones cannot all have begun: `cancel` must withdraw those that have "
                "not, and return their ids"
            )
            assert set(taken) <= {task.id for task in long}, "only what is asked for is withdrawn"
            outcomes: list[Outcome] = []
            drain(executor, outcomes)
            left = [task for task in (*short, *long) if task.id not in set(taken)]
            assert Counter(o.task for o in outcomes) == Counter(task.id for task in left), (
                "what `cancel` returned is not answered, and all else is"
            )
            check({o.task: o for o in outcomes if o.task < 1000}, short)
            assert all(outcome.ok for outcome in outcomes if outcome.task >= 1000)
            assert executor.cancel([short[0].id]) == []

    @EACH
    def test_one_worker_answers_what_it_is_asked_in_turn(self, setup):
        tasks = make_tasks(6)
        assert isinstance(setup.executor, WorkerPool)
        outcomes = setup.executor.one_worker(tasks)
        assert [outcome.task for outcome in outcomes] == [task.id for task in tasks], (
            "`one_worker` answers in the order of the tasks"
        )
        check({outcome.task: outcome for outcome in outcomes}, tasks)
        again = setup.executor.one_worker(tasks, last=True)
        assert all(same(one, other) for one, other in zip(outcomes, again, strict=True))
        assert setup.executor.completed() == [], "`one_worker` alone returns these outcomes"

    @EACH
    def test_a_worker_that_let_its_instance_go_answers_the_same(self, setup):
        tasks = make_tasks(24)
        check(gather(setup.executor, tasks), tasks)
        for workers in (1, setup.executor.workers):
            setup.executor.free_instances(workers)
            check(gather(setup.executor, tasks), tasks)

    @SELDOM_ON_RAY
    def test_all_that_are_done_come_together(self, setup):
        for seconds in (0.1, 1.0, 10.0):  # until each has answered its own, however busy all is
            with setup.open(SPRING, EXPERIMENTS) as executor:  # which knows of no quick ones yet
                executor.submit(make_tasks(executor.workers))
                time.sleep(seconds)
                if len(executor.completed()) == executor.workers:
                    return
        pytest.fail("`completed` must return all outcomes that are there, not one at a time")

    @EACH
    def test_an_interrupt_comes_through_while_it_waits(self, setup):
        experiment, long = long_tasks(500)
        with setup.open(SPRING, (*EXPERIMENTS, experiment)) as executor:
            executor.submit(long)
            done = executor.completed()
            assert len(done) < len(long), "`completed` must wait for the first one, not for all"
            interrupt = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
            interrupt.start()
            with pytest.raises(KeyboardInterrupt):
                drain(executor, done)
            interrupt.join()
            assert len(done) < len(long), "an interrupt must end the wait at once"
            executor.close()
            assert executor.busy == 0, "after `close` no worker is busy"

    @SELDOM_ON_RAY
    def test_close_forgets_what_is_queued_and_may_be_called_twice(self, setup):
        with setup.open(SPRING, EXPERIMENTS[:1]) as executor:
            executor.submit([Task(i, 0, np.array([1.0, 30.0])) for i in range(50)])
            executor.close()
            assert executor.completed() == [], "after `close` nothing is completed any more"
            assert executor.busy == 0, "after `close` no worker is busy"
        executor.close()
        executor.free_instances(1)

    @EACH
    @pytest.mark.parametrize(
        ("name", "parameters", "said"),
        [("no_fmu", ("m", "k"), "must be an FMU"), ("mass", ("m", "kk"), "no variable 'kk'")],
    )
    def test_model_that_cannot_be_loaded_is_a_model_error(self, setup, name, parameters, said):
        archive = b"not a zip file" if name == "no_fmu" else SPRING.archive
        model = Model(f"{name}.fmu", archive, SPRING.interface, SPRING.solver, parameters)
        with pytest.raises(ModelError, match=said) as caught:
            setup.open(model, EXPERIMENTS)
        assert type(caught.value) is ModelError
        assert "\n" not in str(caught.value)


ELSEWHERE = [
    pytest.param(key, marks=() if key == "processes-2" else SLOW)
    for key, (name, _) in OPENERS.items()
    if not executor_class(name).in_process
]


@pytest.mark.parametrize("setup", ELSEWHERE, indirect=True)
def test_task_that_aborts_its_process_is_a_crash_and_spares_all_others(setup, built_fmu):
    times = np.linspace(0.0, 2.0, 9)
    inputs = (Input("u", times, np.sin(times)),)
    experiment = Experiment("e", 0.0, 2.0, inputs, (Output("y", times, np.zeros(9)),))
    model = Model("crashes.fmu", built_fmu("crashes"), "co_simulation", Solver("fmu"), ("rate",))
    evaluator = Evaluator(model, [experiment], "reference")
    with setup.open(model, (experiment,)) as executor:
        for count, killers in ((40, {17, 18}), (4, {0})):
            rates = np.linspace(0.1, 1.9, count)
            rates[list(killers)] = 3.0
            tasks = [Task(i, 0, np.array([rate])) for i, rate in enumerate(rates)]
            for i, outcome in gather(executor, tasks).items():
                if i in killers:
                    assert outcome.status is Status.CRASH
                    assert re.search("process crashed during.*SIGABRT", outcome.message)
                    assert outcome.residuals is None
                else:
                    assert same(outcome, evaluator.evaluate(TaskBatch.of([tasks[i]]))[0])
            check_nothing_is_left(executor)
    evaluator.close()
