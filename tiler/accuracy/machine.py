"""What the figures were measured on."""

import os
import platform
from contextlib import suppress
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import rasterio

_PACKAGES = ("clipmap", "numpy", "numba", "OpenImageIO", "rasterio")


def describe_machine() -> dict[str, str]:
    """Return processor, system, versions and time (UTC) by name."""
    versions = {package: version(package) for package in _PACKAGES}
    return {
        "processor": _processor(),
        "processors": f"{len(os.sched_getaffinity(0))} usable, 1 thread used",
        "system": f"{platform.system()} {platform.machine()}",
        "Python": platform.python_version(),
        **versions,
        "GDAL": rasterio.__gdal_version__,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
