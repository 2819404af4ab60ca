"""Words for devices; what a machine lacks is refused in one line."""

import pytest
import torch

from evercal.errors import InputError
from evercal.features import device as module
from evercal.features.device import allow_tf32, device_of, device_of_network

from ..one_device import META


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch):
    """Makes torch say that there are so many CUDA devices, of which number 1 is the current."""

    def pretend(count: int) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)

    return pretend


def test_auto_takes_the_current_cuda_device_where_there_is_one(gpus) -> None:
    gpus(0)
    assert device_of("auto") == device_of() == device_of("cpu") == torch.device("cpu")
    gpus(2)
    assert device_of("auto") == device_of("cuda") == torch.device("cuda", 1)
    assert device_of("cuda:0") == device_of(torch.device("cuda", 0)) == torch.device("cuda", 0)
    assert device_of("cpu") == device_of(torch.device("cpu")) == torch.device("cpu")


@pytest.mark.parametrize(
    ("word", "count", "told"),
    [
        ("cuda", 0, "finds no CUDA device"),
        ("cuda:0", 0, "finds no CUDA device"),
        ("cuda:2", 2, "has 2 CUDA devices"),
        ("gpu", 2, "take auto, cpu or cuda"),
        ("cuda:x", 2, "take auto, cpu or cuda"),
        ("cuda:", 2, "take auto, cpu or cuda"),
        ("mps", 0, "take auto, cpu or cuda"),
        ("", 0, "take auto, cpu or cuda"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(gpus, word: str, count: int, told: str) -> None:
    gpus(count)
    with pytest.raises(InputError, match=told) as refused:
        device_of(word)
    assert f"device {word!r}" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_network_is_where_its_weights_or_buffers_are() -> None:
    assert device_of_network(torch.nn.Linear(2, 2, device=META)) == META
    assert device_of_network(torch.nn.BatchNorm1d(2, affine=False, device=META)) == META
    assert device_of_network(torch.nn.Identity()) == torch.device("cpu")
    assert device_of_network(lambda grey: grey) == torch.device("cpu")


def test_nothing_changes_on_the_cpu() -> None:
    before = torch.get_float32_matmul_precision()
    allow_tf32(torch.device("cpu"))
    assert torch.get_float32_matmul_precision() == before
    assert module.DEVICES == ("auto", "cpu", "cuda")
