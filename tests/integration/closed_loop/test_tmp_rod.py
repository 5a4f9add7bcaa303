import numpy as np, pytest, time
from dataclasses import replace
from scipy.linalg import expm
from support.truth.systems_with_missing_effects import opened
import cluster_est as ce
from cluster_est.closed_loop.fitter import FitStart
from cluster_est.closed_loop.screening import screen as S
from cluster_est.closed_loop.screening.places import rank_places
from cluster_est.closed_loop.candidates.arguments import *
from cluster_est.closed_loop.candidates.make import OpenSites
from cluster_est.closed_loop.settings import LoopStage
from cluster_est.statistics.projection import OrthogonalProjection, ProjectedResidual
import integration.closed_loop.test_many_states as M

NODES = 12


def temps(heat, node, k, tau, src=None):
    n = NODES + 1
    nb = np.eye(NODES, k=1) + np.eye(NODES, k=-1)
    r = np.zeros((n, n))
    r[:NODES, :NODES] = 0.3 * (nb - np.diag(nb.sum(axis=1))) - 0.005 * np.eye(NODES)
    r[node - 1, (src or node) - 1] -= k
    r[node - 1, NODES] += k
    r[NODES, (src or node) - 1] += 1 / tau
    r[NODES, NODES] -= 1 / tau
    J = np.zeros((n + 1, n + 1))
    J[:n, :n] = r
    J[0, n] = 1.0
    st = expm(J * (M.TIMES[1] - M.TIMES[0]))
    out = np.zeros((len(M.TIMES), n))
    for i in range(len(M.TIMES) - 1):
        out[i + 1] = st[:n, :n] @ out[i] + st[:n, n] * heat[i]
    return out[:, :NODES]


def exper(number, node, k, tau, src=None):
    random = np.random.default_rng([5, number])
    heat = M.heating(number)
    c = temps(heat, node, k, tau, src) + M.SIGMA * random.normal(size=(len(M.TIMES), NODES))
    outs = tuple(ce.Output(f"y{i}", M.TIMES, c[:, i - 1], M.SIGMA) for i in M.MEASURED)
    return ce.Experiment(
        f"e{number}",
        0.0,
        float(M.TIMES[-1]),
        (ce.Input("heating", M.TIMES, heat, "hold"),),
        outs,
        role=M.ROLES[number],
    )


import cluster_est.closed_loop.screening.places as P

FF = P.free_filters


def test_it(built_fmu):
    model = ce.Model(
        "heat_rod",
        built_fmu("heat_rod"),
        "model_exchange",
        ce.Solver("dormand_prince"),
        tuple(M.TRUE),
    )
    pars = tuple(ce.Parameter(n, 0.8 * v, (0.1 * v, 10.0 * v)) for n, v in M.TRUE.items())
    g = np.random.default_rng(3)
    for trial in range(14):
        node = int(g.integers(2, 12))
        src = node if trial % 2 else int(g.integers(1, 13))
        k = float(np.exp(g.uniform(np.log(0.004), np.log(0.1))))
        tau = float(np.exp(g.uniform(np.log(5), np.log(150))))
        problem = ce.Problem(model, pars, tuple(exper(e, node, k, tau, src) for e in range(4)))
        with opened(problem) as bench:
            f = bench.fitter
            (fitted,) = f.fit(
                LoopStage.DECLARED_MODEL, [FitStart(f.problem, {})], ce.LeastSquares()
            )
            tr = f.trajectories(fitted)
            given = (fitted.problem, f.description, tr)
            opened_, args = OpenSites(*given, bench.settings), open_arguments(*given)
            pl = open_places(opened_.all, args, tr)
            res = ProjectedResidual(OrthogonalProjection(fitted.jacobian), fitted.residuals)
            out = []
            tt = []
            for ff, w, seed, L in (
                (lambda *a: (), 96, 7, 4),
                (FF, 96, 9, 4),
                (FF, 128, 7, 4),
                (FF, 128, 8, 4),
                (FF, 128, 7, 3),
                (FF, 128, 8, 3),
                (FF, 160, 8, 4),
                (FF, 160, 8, 3),
            ):
                P.free_filters = ff
                P.WEIGHTINGS = w
                P.LAGS = L
                t0 = time.process_time()
                ranked = P.rank_places(pl, tr, res, [0.1, 0.2], f.generator(seed))
                names = [(str(p.site), p.argument) for p in ranked]
                tt.append(round(time.process_time() - t0, 2))
                out.append(
                    names.index((f"der(T{node})", f"T{src}"))
                    if (f"der(T{node})", f"T{src}") in names
                    else None
                )
            print(
                "ROD",
                node,
                src,
                round(k, 4),
                round(tau, 1),
                "sse/n",
                round(fitted.sse / f.size, 1),
                "ranks plain,plain,filt,filt,filt160,plain2000,filt2000",
                out,
                tt,
                len(names),
                flush=True,
            )
