"""Names of devices; missing devices are refused in one line."""

import pytest
import torch

from evercal.continual.networks.device import device_of, device_of_network, tf32
from evercal.errors import InputError

from ...one_device import META


@pytest.fixture
def gpus(monkeypatch: pytest.MonkeyPatch):
    """Set the number of CUDA devices that torch reports; the current device is 1."""

    def pretend(count: int) -> None:
        monkeypatch.setattr(torch.cuda, "is_available", lambda: count > 0)
        monkeypatch.setattr(torch.cuda, "device_count", lambda: count)
        monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)

    return pretend


def test_auto_is_the_current_cuda_device_if_there_is_one(gpus) -> None:
    gpus(0)
    assert device_of("auto") == device_of() == device_of("cpu") == torch.device("cpu")
    gpus(2)
    assert device_of("auto") == device_of("cuda") == torch.device("cuda", 1)
    assert (
        device_of("cuda:0")
        == device_of(torch.device("cuda", 0))
        == torch.device("cuda", 0)
    )
    assert device_of("cpu") == device_of(torch.device("cpu")) == torch.device("cpu")


@pytest.mark.parametrize(
    ("name", "count", "message"),
    [
        ("cuda", 0, "finds no CUDA device"),
        ("cuda:2", 2, "has 2 CUDA devices"),
        ("gpu", 2, "use auto, cpu or cuda"),
        ("cuda:x", 2, "use auto, cpu or cuda"),
        ("", 0, "use auto, cpu or cuda"),
    ],
)
def test_missing_devices_are_refused_in_one_line(
    gpus, name: str, count: int, message: str
) -> None:
    gpus(count)
    with pytest.raises(InputError, match=message) as refused:
        device_of(name)
    assert f"device {name!r}" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_device_of_a_network_is_that_of_its_weights_or_buffers() -> None:
    assert device_of_network(torch.nn.Linear(2, 2, device=META)) == META
    assert device_of_network(torch.nn.BatchNorm1d(2, affine=False, device=META)) == META
    assert device_of_network(torch.nn.Identity()) == torch.device("cpu")


def test_tf32_is_set_on_a_gpu_only_and_restored() -> None:
    def now() -> bool:
        return bool(torch.backends.cuda.matmul.allow_tf32)

    before = now()
    with tf32(torch.device("cpu")):
        assert now() == before
    with tf32(torch.device("cuda", 0)):
        assert now()
    assert now() == before
