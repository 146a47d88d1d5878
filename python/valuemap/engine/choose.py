"""The engine by its name."""

from __future__ import annotations

from valuemap.engine.engine import Engine
from valuemap.engine.threads import ThreadEngine
from valuemap.errors import SettingError

ENGINES = ("threads", "ray")


def engine_named(name: str, *, threads: int = 0, ray_address: str | None = None) -> Engine:
    """Return an engine; it is ready to run.

    Raises
    ------
    SettingError
        There is none of this name, or it has no use for an address.
    ClusterError
        As `RayEngine`.
    """
    if name not in ENGINES:
        raise SettingError(f"--engine {name}: there is no such engine", hint=f"choose one of {', '.join(ENGINES)}")
    if name == "threads":
        if ray_address is not None:
            raise SettingError("--ray-address: the engine threads has no address", hint="add --engine ray")
        return ThreadEngine(threads)
    from valuemap.engine.ray import RayEngine  # Imports Ray, which takes a second.

    return RayEngine(ray_address)
