from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pretend
import pytest
import torch


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--device", default="cpu", help="where tests run: cpu (default), cuda or pretend")


def pytest_configure(config: pytest.Config) -> None:
    # The suite runs one process per core; torch's own threads would only fight over them.
    torch.set_num_threads(1)
    if config.getoption("--device") == pretend.NAME:
        pretend.register()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """On a device only what runs there, and on one that is pretended nothing that needs hardware; on the CPU no
    comparison with the CPU.
    """
    name = config.getoption("--device")
    fixtures = {"device"} if name == pretend.NAME else {"device", "hardware"}

    def runs(item: pytest.Item) -> bool:
        if name == "cpu":
            return item.path.name != "test_devices.py"
        return bool(fixtures & set(item.fixturenames))  # type: ignore[attr-defined]

    config.hook.pytest_deselected(items=[item for item in items if not runs(item)])
    items[:] = [item for item in items if runs(item)]


@pytest.fixture
def device(request: pytest.FixtureRequest) -> Iterator[torch.device]:
    """Where a test runs; see --device."""
    name = request.config.getoption("--device")
    if name == pretend.NAME:
        with pretend.device() as device:
            yield device
    else:
        yield _real(name)


@pytest.fixture
def hardware(request: pytest.FixtureRequest) -> torch.device:
    """A device with kernels and generators of its own."""
    return _real(request.config.getoption("--device"))


def _real(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        pytest.fail("--device cuda, but torch sees no GPU.")
    return torch.device(name, 0) if name == "cuda" else torch.device(name)


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def tables() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_tables", Path(__file__).parents[1] / "tools" / "make_tables.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def colour(tables: ModuleType) -> ModuleType:
    return tables.import_colour()
