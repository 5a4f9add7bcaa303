import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cluster_est.cli.parser import parse

FOLDER = Path(__file__).parents[3] / "scripts" / "cluster"
SHELL = sorted(FOLDER.glob("*.sh"))
TEXTS = [*SHELL, *sorted(FOLDER.glob("*.yaml")), FOLDER / "Dockerfile"]

# From KubeRay's page "KubeRay CRD API reference" for v1.6.2, as far as the file could use them
RAY_JOB_SPEC = {
    *("activeDeadlineSeconds", "backoffLimit", "rayClusterSpec", "submitterPodTemplate"),
    *("metadata", "clusterSelector", "submitterConfig", "managedBy", "deletionStrategy"),
    *("entrypoint", "runtimeEnvYAML", "jobId", "submissionMode", "entrypointResources"),
    *("entrypointNumCpus", "ttlSecondsAfterFinished", "shutdownAfterJobFinishes", "suspend"),
}
CLUSTER_SPEC = {
    *("authOptions", "suspend", "managedBy", "autoscalerOptions", "headServiceAnnotations"),
    *("enableInTreeAutoscaling", "gcsFaultToleranceOptions", "headGroupSpec", "rayVersion"),
    "workerGroupSpecs",
}
HEAD_SPEC = {"template", "headService", "enableIngress", "rayStartParams", "serviceType"}
WORKER_SPEC = {
    *("suspend", "groupName", "replicas", "minReplicas", "maxReplicas", "idleTimeoutSeconds"),
    *("rayStartParams", "template", "scaleStrategy", "numOfHosts"),
}


def read(name):
    return yaml.safe_load((FOLDER / name).read_text(encoding="utf-8"))


def check_command(words):
    """A command of this project that its own command line accepts."""
    assert words[0] == "cluster-est"
    return parse(words[1:])


@pytest.mark.parametrize("script", SHELL, ids=lambda path: path.name)
def test_an_unfilled_script_says_so(script):
    done = subprocess.run(["bash", str(script)], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "fill in the values" in done.stderr


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_nothing_floats_and_no_token_is_written_down(path):
    text = path.read_text(encoding="utf-8")
    assert not re.search(r":latest\b|image: [\w./-]+$(?<!FILL_IN_IMAGE)", text, re.MULTILINE)
    assert not re.search(r"(?i)token['\"]?\s*[:=]\s*['\"]?[0-9a-f]{16}", text)
    assert re.search(r"RAY_AUTH_MODE=token|authOptions:|name: RAY_AUTH_MODE", text)


def test_the_image_pins_what_it_installs():
    docker = (FOLDER / "Dockerfile").read_text(encoding="utf-8")
    assert re.search(r"^FROM python:\d+\.\d+\.\d+-", docker, re.MULTILINE)
    pins = (FOLDER / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in pins if not line.startswith("#")]
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins)
    project = (FOLDER.parents[1] / "pyproject.toml").read_text(encoding="utf-8")
    wanted = re.search(r"^dependencies = \[(.*?)\]", project, re.MULTILINE | re.DOTALL)[1]
    names = {pin.split("==")[0] for pin in pins}
    assert set(re.findall(r'"([\w-]+)', wanted)) <= names


def test_the_ray_job_uses_documented_fields_and_an_existing_command():
    job = read("rayjob.yaml")
    spec, cluster = job["spec"], job["spec"]["rayClusterSpec"]
    assert (job["apiVersion"], job["kind"]) == ("ray.io/v1", "RayJob")
    assert set(spec) <= RAY_JOB_SPEC
    assert set(cluster) <= CLUSTER_SPEC
    assert set(cluster["headGroupSpec"]) <= HEAD_SPEC
    assert all(set(group) <= WORKER_SPEC for group in cluster["workerGroupSpecs"])
    assert cluster["authOptions"] == {"mode": "token"}
    ray_pin = re.search(r"^ray==(.+)$", (FOLDER / "constraints.txt").read_text(), re.MULTILINE)
    assert cluster["rayVersion"] == ray_pin[1]
    groups = [cluster["headGroupSpec"], *cluster["workerGroupSpecs"]]
    assert all(isinstance(v, str) for g in groups for v in g["rayStartParams"].values())
    options = check_command(shlex.split(spec["entrypoint"]))
    assert options.overrides == ["executor.name=ray", "executor.address=auto"]


def test_the_cron_job_submits_a_sweep_with_the_token_of_a_secret():
    job = read("cronjob.yaml")
    assert (job["apiVersion"], job["kind"]) == ("batch/v1", "CronJob")
    pod = job["spec"]["jobTemplate"]["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    assert container["command"][:3] == ["ray", "job", "submit"]
    assert container["command"][-1] == "--"
    check_command(container["args"])
    variables = {each["name"]: each for each in container["env"]}
    assert variables["RAY_AUTH_MODE"]["value"] == "token"
    assert variables["RAY_AUTH_TOKEN"]["valueFrom"]["secretKeyRef"]["key"] == "auth_token"


STUBS = {
    "ray": 'printf "%s\\n" "$@" > "$CALLS"\n'
    'printf "%s" "$RAY_AUTH_MODE ${RAY_AUTH_TOKEN-} ${RAY_AUTH_TOKEN_PATH-}" > "$CALLS.env"\n'
    '[ -z "${RAY_FAILS-}" ] || exit 0\nmkdir -p "$OUT"; echo "{}" > "$OUT/run.json"',
    "srun": 'while [ "${1#--}" != "$1" ]; do shift; done; exec "$@"',
    "scontrol": "echo n1; echo n2",
    "hostname": "echo fe80::1 10.0.0.1 10.0.0.2",
}


def run_filled(name, tmp_path, values, **environment):
    """Run a script with its values filled in and the cluster's commands replaced by stubs."""
    bin_folder = tmp_path / "bin"
    bin_folder.mkdir(exist_ok=True)
    for stub, body in STUBS.items():
        (bin_folder / stub).write_text(f"#!/usr/bin/env bash\n{body}\n", encoding="utf-8")
        (bin_folder / stub).chmod(0o755)
    if not (bin_folder / "python").exists():
        (bin_folder / "python").symlink_to(sys.executable)
    text = (FOLDER / name).read_text(encoding="utf-8")
    filled = re.sub(r"^(\w+)='FILL_IN'", lambda m: f"{m[1]}='{values[m[1]]}'", text, flags=re.M)
    script = tmp_path / name
    script.write_text(filled, encoding="utf-8")
    paths = {"PATH": f"{bin_folder}:{os.environ['PATH']}", "CALLS": str(tmp_path / "calls")}
    clean = {k: v for k, v in os.environ.items() if not k.startswith("RAY_")}
    done = subprocess.run(
        ["bash", str(script)],
        env=clean | paths | {"OUT": values["out"]} | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    calls = tmp_path / "calls"
    return done, calls.read_text().splitlines() if calls.exists() else []


def test_ray_job_submits_a_fit_without_showing_the_token_and_not_without_one(tmp_path):
    token = tmp_path / "token"
    token.write_text("0123", encoding="utf-8")
    values = {"address": "http://h:8265", "token_file": token, "folder": "here"}
    values |= {"config": "first.toml", "out": str(tmp_path / "run")}
    done, words = run_filled("ray_job.sh", tmp_path, values)
    assert done.returncode == 0, done.stderr
    begin = shlex.split("job submit --address http://h:8265 --working-dir here --")
    assert words[:7] == begin
    assert check_command(words[7:]).overrides == ["executor.name=ray", "executor.address=auto"]
    assert (tmp_path / "calls.env").read_text().split() == ["token", str(token)]
    assert "0123" not in " ".join(words)
    token.unlink()
    done, _ = run_filled("ray_job.sh", tmp_path, values)
    assert done.returncode == 2
    assert "must hold the cluster's token" in done.stderr


NODES = {"SLURM_JOB_NODELIST": "n[1-2]", "SLURM_JOB_NUM_NODES": "2", "SLURM_CPUS_PER_TASK": "16"}


def test_slurm_runs_a_fit_on_all_nodes_with_a_token_of_its_own_and_says_where_ray_fails(tmp_path):
    values = {"environment": "/env", "config": "first.toml", "out": str(tmp_path / "run")}
    done, words = run_filled("slurm.sh", tmp_path, values, **NODES)
    assert done.returncode == 0, done.stderr
    begin = shlex.split("symmetric-run --address 10.0.0.1:6379 --min-nodes 2 --num-cpus 16 --")
    assert words[: len(begin)] == begin
    assert check_command(words[len(begin) :]).out == tmp_path / "run"
    mode, token = (tmp_path / "calls.env").read_text().split()
    assert mode == "token"
    assert re.fullmatch(r"[0-9a-f]{64}", token)
    (tmp_path / "run" / "run.json").unlink()
    done, _ = run_filled("slurm.sh", tmp_path, values, **NODES, RAY_FAILS="1")
    assert done.returncode == 1
    assert "no fit was run" in done.stderr
