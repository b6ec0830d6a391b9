"""Where the sun stands at a time, as seen from a place: by PyEphem, whose VSOP 87 is good to arc seconds between 1800 and 2200.

PyEphem needs no files and no network, has no dependencies, and wheels for every platform.
"""

import math
from datetime import UTC, datetime

from schemas.errors import MissingExtraError, UsageError


def sun_position(when: datetime, longitude_deg: float, latitude_deg: float) -> tuple[float, float]:
    """Return azimuth (clockwise from true north) and elevation of the centre of the sun's disc [degrees], as if there were no air.

    ``when`` must have an offset from UTC, else UsageError. Raises MissingExtraError without PyEphem.
    """
    if when.tzinfo is None:
        raise UsageError(f"--when {when.isoformat()}: add the offset from UTC, e.g. {when.isoformat()}Z")
    try:
        import ephem  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise MissingExtraError("--when needs PyEphem: pip install 'clipmap[light]'") from error
    observer = ephem.Observer()
    observer.lon, observer.lat = math.radians(longitude_deg), math.radians(latitude_deg)
    observer.elevation, observer.pressure = 0, 0
    observer.date = ephem.Date(when.astimezone(UTC).replace(tzinfo=None))
    sun = ephem.Sun(observer)
    return math.degrees(sun.az), math.degrees(sun.alt)


def refracted_deg(elevation_deg: float) -> float:
    """Return the elevation at which the air shows a body that stands at ``elevation_deg``, both above the horizontal [degrees].

    Saemundsson, Sky and Telescope 72 (1986), p. 70: 1.02' / tan(h + 10.3 / (h + 5.11)) at 1010 hPa and 10 degrees Celsius; 28.9' at the
    horizon. Below -1 degree it means nothing: the lift is that of -1 degree there, and the sun is down anyway.
    """
    seen = max(elevation_deg, -1.0)
    lift = 1.02 / 60 / math.tan(math.radians(seen + 10.3 / (seen + 5.11)))
    return min(elevation_deg + max(lift, 0.0), 90.0)


def unrefracted_deg(seen_deg: float) -> float:
    """Return the elevation [degrees] at which a body stands that is seen at ``seen_deg``: the inverse of ``refracted_deg``, to 1e-12."""
    low, high = seen_deg - 1.0, seen_deg
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if refracted_deg(middle) < seen_deg else (low, middle)
    return high
