"""Optional packages: which are missing, and how to install them."""

from importlib.util import find_spec

from formats.errors import PrtbakeError

EVALUATE = ("matplotlib", "skimage", "flip_evaluator")
"""The modules of the extra `evaluate`: plots, SSIM and FLIP."""
_PACKAGES = {"skimage": "scikit-image", "flip_evaluator": "flip-evaluator"}


def missing_sentence(*modules: str) -> str:
    """Return which of the modules are not installed and the command that installs them; empty if none is missing."""
    packages = [_PACKAGES.get(module, module) for module in modules if find_spec(module) is None]
    if not packages:
        return ""
    verb = "is" if len(packages) == 1 else "are"
    return f"{', '.join(packages)} {verb} not installed; pip install {' '.join(packages)}"


def require(task: str, *modules: str) -> None:
    """Refuse a task, before it begins, whose optional modules are not installed.

    Raises PrtbakeError that begins with the task and names the command that installs what is missing.
    """
    if sentence := missing_sentence(*modules):
        raise PrtbakeError(f"{task}: {sentence}")
