"""One training run: its data, its learner and its progress."""

import json
import math
import time
from collections.abc import Callable
from copy import deepcopy
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from prt_bake.network.bssrdf import save_model
from prt_bake.network.low_bands import LowBands
from prt_bake.network.model import TrainableModel
from prt_bake.trainer.budget import Budget
from prt_bake.trainer.cores import available_cores
from prt_bake.trainer.fit import Fit
from prt_bake.trainer.history import Meter, TrainingProgress, every_tenth
from prt_bake.trainer.learning import correction, low_bands
from prt_bake.trainer.learning.learner import LearningSettings
from prt_bake.trainer.learning.prefetch import Prefetcher
from prt_bake.trainer.resume import read_state, write_state
from prt_bake.trainer.samples.rows import RowSource
from prt_bake.trainer.training_data import TrainingData

_SHARE_OF_SAVES = 0.05
"""Largest share of the time of learning that checkpoints take; long runs have up to 690 MB of queries in them."""
_LOW_BANDS = low_bands.SHARE_OF_TIME / (low_bands.SHARE_OF_TIME + correction.SHARE_OF_TIME)
"""The share of low bands in the time after learning."""
Progress = Callable[[TrainingProgress], None]
Part = Callable[[str, float], None]


class Request(NamedTuple):
    """The length of a run, the file of its model, and functions that follow it: see `prt_bake.trainer.train`."""

    steps: int | None
    budget: Budget | None
    output: str | Path | None
    progress: Progress
    part: Part
    stop: Callable[[], bool]


class Run:
    """One training run: its data, its learner and its progress."""

    def __init__(
        self,
        data: TrainingData,
        fit: Fit,
        learning: LearningSettings,
        seed: int,
        request: Request,
        resume: bool = False,
    ) -> None:
        """Trace the validation queries, make the model and its learner, and with `resume` continue from the checkpoint
        beside the output.
        """
        self.data, self.learning, self.seed, self.scene = data, learning, seed, data.scene
        self.steps, self.budget, self.output, self.progress, self.part, self.stop = request
        budget, part = self.budget, self.part
        self.resume_settings = {**fit.resume_settings, "seed": seed, "muon": learning.muon, **data.resume_settings}
        self.synchronous = bool(self.resume_settings["synchronous"])
        assert request.output is not None or not resume
        state = read_state(str(request.output), data.scene.content_hash, self.resume_settings) if resume else None
        self.reference = data.reference(
            learning, math.inf if budget is None else budget.validation, partial(part, "validation queries")
        )
        model: Any = fit.model(self.reference.scale() or 1.0)
        self.low = getattr(model, "low", None)
        """The low bands before they are fitted, which the model lacks until then."""
        self.earlier_low = getattr(fit, "earlier_low", None)
        """Low bands of the network to start from, or of the run that is resumed, which stay if they have less error.

        A run that learns from values has none."""
        self.earlier_correction = getattr(fit, "earlier_correction", None)
        """The correction of the values that belongs to them."""
        self.fitted_low: LowBands | None = None
        """The low bands that were fitted last, for a run that is resumed."""
        self.low_seconds = 0.0
        if self.low is not None:
            model.set_low_bands(None)
        # The faster precision is measured by a clock, which must not decide the bits of a synchronous run.
        self.learner = fit.learner(model, replace(learning, bfloat16=False) if self.synchronous else learning)
        self.generator = np.random.default_rng(seed)
        self.seconds = 0.0
        self.length = math.inf
        """Seconds of learning of the complete run, if it ends by time."""
        self.stopped = False
        self.source: RowSource | None = None
        self.traced_state: dict[str, Any] | None = None
        self.source_state: dict[str, int] | None = None
        self.history: list[TrainingProgress] = []
        if state is not None:
            self._restore(state)

    def _restore(self, state: dict[str, Any]) -> None:
        for network in (self.learner.network, self.learner.model):
            network.output_scale = float(state["output_scale"])
        self.learner.restore(state["learner"])
        self.generator.bit_generator.state = json.loads(state["generator"])
        self.seconds, self.source_state = float(state["seconds"]), dict(state["source"])
        self.traced_state = state["queries"]
        if self.low is not None and state.get("low") is not None:
            self.earlier_low, self.earlier_correction = deepcopy(self.low), None
            self.earlier_low.load_state_dict(state["low"])
        self.history = [TrainingProgress(**report) for report in state["history"]]

    def nothing_left(self) -> bool:
        """Whether a resumed run had the requested length."""
        if self.steps is not None:
            return self.learner.step >= self.steps
        return self.budget is not None and (self.budget.left <= 0.0 or self.budget.learning(self.seconds) <= 0.0)

    def state(self) -> dict[str, Any]:
        """The checkpoint's content: plain values and tensors."""
        assert self.source is not None
        return {
            "scene": self.scene.content_hash,
            "begun": self.resume_settings,
            "output_scale": self.learner.network.output_scale,
            "learner": self.learner.state(),
            "generator": json.dumps(self.generator.bit_generator.state, allow_nan=False),
            "source": self.source.state(),
            "queries": self.source.traced.state() if self.low is not None and self.source.traced is not None else None,
            "low": None if self.fitted_low is None else self.fitted_low.state_dict(),
            "seconds": self.seconds,
            **({} if self.budget is None else {"spent": self.budget.spent}),
            "history": [asdict(report) for report in self.history],
        }

    def learn(self) -> None:
        """Learn until the end of the run, or until it is stopped."""
        device = self.learner.network.box_min.device.type
        self.source = self.data.source(self.learning, self.learner.network, self.source_state)
        if self.traced_state is not None and self.source.traced is not None:
            where = self.learner.network.box_min.device if self.data.on_gpu else "cpu"
            self.source.traced.restore(self.traced_state, where)
        threads_before = torch.get_num_threads()
        threads = self.data.learner_threads(self.learning, device)
        prefetching = 0 if self.synchronous or device != "cpu" else threads
        prefetcher = Prefetcher(self.source, self.learner, prefetching)
        torch.set_num_threads(threads)
        try:
            with self.learner.stream():
                self._learn(self.source, prefetcher)
        except KeyboardInterrupt:
            if self.learner.step == 0:
                raise
            self.stopped = True
        finally:
            self.source.stop()
            prefetcher.stop()
            torch.set_num_threads(threads_before)

    def _learn(self, source: RowSource, prefetcher: Prefetcher) -> None:
        before = self.seconds
        self._set_length(before)
        first, begun = True, time.perf_counter()
        next_save = begun + self.learning.checkpoint_every
        meter = Meter(source.statistics())
        source.start()
        meter.add_wait(meter.seconds)
        self.part("learning", self.share)
        while (share := self.share) < 1.0:
            if self.stop():
                raise KeyboardInterrupt
            requested = time.perf_counter()
            batch, encoding = prefetcher.draw()
            meter.add_wait(time.perf_counter() - requested)
            meter.add_step(self.learner.learn(source, batch, share, self.generator, encoding), len(batch.rows))
            if first and self.budget is not None:  # it has compiled and loaded kernels, which is not learning
                begun = time.perf_counter()
                self._set_length(before)
            first = False
            self.seconds = before + time.perf_counter() - begun
            if meter.seconds > self.learning.report_every:
                self._report(meter, self.share, source)
                meter = Meter(source.statistics())
            if (now := time.perf_counter()) > next_save:
                self.save()
                took = time.perf_counter() - now
                next_save = now + took + max(self.learning.checkpoint_every, took / _SHARE_OF_SAVES)
        self.learner.check(source)
        if not meter.empty:
            self._report(meter, 1.0, source)

    def _set_length(self, before: float) -> None:
        """Set the length of a run by time that has learned for `before` seconds: low bands are fitted after it."""
        if self.budget is not None:
            self.length = before + (1.0 - self._share_of_low_bands) * self.budget.learning(before)

    @property
    def _share_of_low_bands(self) -> float:
        """The share of the time of learning in which low bands, and the correction of the values, are fitted."""
        traced = self.source is not None and self.source.traced is not None
        return low_bands.SHARE_OF_TIME + correction.SHARE_OF_TIME if traced and self.low is not None else 0.0

    @property
    def share(self) -> float:
        """The share of the run that is over, by steps if given, else by time."""
        if self.steps is not None:
            return self.learner.step / self.steps
        return self.seconds / self.length if self.length > 0.0 else 1.0

    def _report(self, meter: Meter, share: float, source: RowSource) -> None:
        validation = self.reference.relative_rmse(self.learner.model)
        consumed = self.learner.step * self.learning.batch
        report = meter.progress(self.seconds, self.learner.step, share, consumed, source.statistics(), validation)
        self.history.append(report)
        self.progress(report)

    def save(self) -> None:
        """Write the model and its checkpoint, unless the run has no file."""
        if self.output is None:
            return
        assert self.source is not None
        self.learner.check(self.source)
        save_model(self.learner.model, self.output)
        write_state(self.output, self.state())

    def finish(self) -> TrainableModel:
        """Fit the low bands and measure the final errors unless the run was stopped, and write the model.

        A KeyboardInterrupt ends the fit or the measurement, and keeps what was learned.
        """
        assert self.source is not None
        self.save()  # the rest takes long and may be interrupted
        network = self.learner.result()
        try:
            network = self._with_low_bands(network)
        except KeyboardInterrupt:
            self.stopped = True
        seconds, walks = self.seconds + self.low_seconds, self.source.statistics().walks
        errors = [[report.seconds, report.walks, report.validation] for report in every_tenth(self.history)]
        if self.low_seconds > 0.0:
            errors.append([seconds, walks, self.reference.relative_rmse(network)])
        training: dict[str, Any] = {
            "seconds": seconds,
            "steps": self.learner.step,
            "walks": walks,
            "seed": self.seed,
            "learning": asdict(self.learning),
            "precision": "bfloat16" if self.learner.bfloat16 else "float32",
            "device": _name_of(network.box_min.device),
            **self.data.description(),
            "validation_vs_time": errors,
            "validation_of": self.reference.quantity,
        }
        network.metadata["training"] = training | {"stopped": True}
        if self.output is not None and not self.stopped:
            save_model(network, self.output)  # its errors take a while
        try:
            training |= {} if self.stopped else self._errors(network)
        except KeyboardInterrupt:
            self.stopped = True
        network.metadata["training"] = training | {"stopped": self.stopped}
        if self.output is not None:
            save_model(network, self.output)
            if not self.stopped:
                write_state(self.output, self.state())  # with all of the time that was spent
        return network

    def _with_low_bands(self, network: Any) -> TrainableModel:
        """The network with low bands that are fitted to all queries of the run.

        It keeps those of an earlier network, or has none, if that has less error.
        """
        assert self.source is not None
        if self.low is None or self.source.traced is None:  # values of a file have no paths that low bands could fit
            assert isinstance(network, TrainableModel)
            return network
        fitted, before = deepcopy(network), deepcopy(network)
        fitted.set_low_bands(self.low)
        before.set_low_bands(deepcopy(self.earlier_low))
        if self.earlier_correction is not None:
            before.set_correction(deepcopy(self.earlier_correction))
        try:
            self._fit_low_bands(fitted)
        except KeyboardInterrupt:
            self.stopped = True
        chosen: Any = min((fitted.rounded(), before.rounded(), network), key=self._error)  # the first of equal ones
        self.fitted_low = chosen.low if chosen.low is not None and chosen.settings == fitted.settings else None
        try:
            self._fit_correction(chosen)
        except KeyboardInterrupt:
            self.stopped = True
        rounded: TrainableModel = chosen.rounded()
        return rounded

    def _error(self, network: Any) -> float:
        """The validation error, infinite if it is unknown."""
        error = self.reference.relative_rmse(network)
        return math.inf if math.isnan(error) else error

    def _fit_low_bands(self, network: Any) -> None:
        """Fit the network's low bands to all queries."""
        self._fit(partial(low_bands.fit_low_bands, network), low_bands.STEPS_A_STEP, 0.0, _LOW_BANDS)

    def _fit_correction(self, network: Any) -> None:
        """Correct the values of a network by its low bands, if it has any, and no correction yet."""
        if network.low is not None and network.correction is None:
            self._fit(partial(correction.fit_correction, network), correction.STEPS_A_STEP, _LOW_BANDS, 1.0)

    def _fit(self, fit: Callable[..., None], steps_a_step: int, begin: float, end: float) -> None:
        """Run a fit to all queries of the run, from one share of the time that is for such fits to another.

        A run that ends by steps has `steps_a_step` of the fit for each of them.
        """
        assert self.source is not None
        queries = None if self.source.traced is None else self.source.traced.joined()
        if self.stopped or queries is None:
            return
        left = math.inf if self.budget is None else self.budget.learning(self.seconds + self.low_seconds)

        def follow(over: float) -> None:
            self.part("low bands", begin + (end - begin) * over)
            if self.stop():
                raise KeyboardInterrupt

        threads_before, begun = torch.get_num_threads(), time.perf_counter()
        torch.set_num_threads(self.data.learner_threads(self.learning, self.learner.network.box_min.device.type))
        threads = 0 if self.synchronous else available_cores()
        seconds = (end - begin) / (1.0 - begin) * left
        steps = None if self.steps is None else steps_a_step * self.learner.step
        try:
            fit(queries, self.learning, self.seed, threads, steps=steps, seconds=seconds, follow=follow)
        finally:
            torch.set_num_threads(threads_before)
            self.low_seconds += time.perf_counter() - begun

    def _errors(self, network: TrainableModel) -> dict[str, Any]:
        """The final errors."""
        seconds = math.inf if self.budget is None else self.budget.figures()
        follow = partial(self.part, "final errors")
        follow(0.0)
        return self.data.errors(network, self.learning, seconds, follow)


def _name_of(device: torch.device) -> str:
    """The name of the GPU that learned, or "cpu"."""
    return str(torch.cuda.get_device_name(device)) if device.type == "cuda" else device.type
