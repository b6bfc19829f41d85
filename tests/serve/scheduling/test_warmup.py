"""The check of a model before it answers: its outputs for the golden image must match."""

import numpy as np
import pytest
from numpy.typing import NDArray

from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import ModelError
from serve.scheduling.warmup import warm_up
from tests.serve.conftest import CARD, FakeEngine, Served, assert_problem, serving, until


def always(answer: NDArray[np.float32]) -> FakeEngine:
    return FakeEngine(lambda _image: answer)


def not_ready_reason(service: Served) -> str:
    reply = service.ask("GET", "/readyz")
    assert_problem(reply, 503, "not-ready")
    return str(reply.content["detail"])


def test_a_model_with_other_outputs_than_the_published_never_gets_ready() -> None:
    right = np.array(CARD.golden, np.float32)
    engine = always(right)
    warm_up(engine)
    assert np.array_equal(engine.images[0], golden_image(280, 210))
    for wrong in (right + np.float32(0.01), right * np.float32(np.nan), right[:8]):
        with pytest.raises(ModelError):
            warm_up(always(wrong))
    rounded = always(right + np.float32(0.02))
    rounded.precision = "bf16"
    warm_up(rounded)
    rounded.respond = lambda _image: right + np.float32(0.04)
    with pytest.raises(ModelError, match=r"at most 0\.03 is expected in bf16"):
        warm_up(rounded)
    with serving(always(right + np.float32(0.01)), warm_up) as service:
        until(lambda: "golden" in not_ready_reason(service))  # at first the reason is the warm-up
        assert service.ask("GET", "/healthz").status == 200
