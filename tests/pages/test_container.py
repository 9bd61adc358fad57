"""The Containerfile builds an image whose command flies a policy on recorded poses.

``VISTHROW_BASE`` names another base image, ``VISTHROW_BUILD`` holds further arguments of the build.
"""

import os
import shlex
import shutil
import subprocess

from pytest import mark, skip

from tests.places import ROOT

IMAGE = "visthrow-test"
BUILDERS = ("podman", "docker", "buildah")
LOGS = ROOT / "tests" / "data" / "payload_cf_single"


def succeeds(*words: str) -> bool:
    """Return whether a command is there and succeeds."""
    return (
        bool(shutil.which(words[0])) and not subprocess.run(words, capture_output=True).returncode
    )


def builder(base: str) -> str:
    """Return a program that can build images on a base; skips the test where there is none."""
    name = next((name for name in BUILDERS if succeeds(name, "info")), None)
    if name is None:
        skip(f"none of {', '.join(BUILDERS)} is installed and answers")
    if not succeeds(name, "inspect", "--type", "image", base) and not succeeds(name, "pull", base):
        skip(f"{name} cannot pull {base}")
    return name


def visthrow(name: str, words: str) -> str:
    """Run a visthrow command in the image, with the logs at /logs, and return what it prints."""
    command = [name, "run", "--volume", f"{LOGS}:/logs:ro"]
    if name == "buildah":  # it runs commands in a container, which is made first
        container = subprocess.check_output([name, "from", IMAGE], text=True).strip()
        command += [container, "--", "visthrow"]
    else:
        command += ["--rm", IMAGE]
    return subprocess.check_output([*command, *words.split()], text=True)


@mark.slow
def test_the_image_flies_on_recorded_poses():
    base = os.environ.get("VISTHROW_BASE", "python:3.12-slim")
    name = builder(base)
    words = ["--build-arg", f"BASE={base}", *shlex.split(os.environ.get("VISTHROW_BUILD", ""))]
    build = [name, "build", *words, "--file", "Containerfile", "--tag", IMAGE, "."]
    subprocess.run(build, cwd=ROOT, check=True)
    assert "visthrow 0." in visthrow(name, "--version")
    words = "hil run --config crazyflie_log --set source.file=/logs/log201.csv.gz --out run"
    assert "run/flight.npz" in visthrow(name, words)
