"""Addresses that only this machine reaches."""

from evercal.service.hosts import is_local


def test_only_loopback_addresses_are_local() -> None:
    assert [is_local(host) for host in ("127.0.0.1", "::1", "localhost")] == [True] * 3
    assert [is_local(host) for host in ("0.0.0.0", "192.168.1.4", "robot")] == [False] * 3
