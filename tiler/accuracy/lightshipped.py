"""What ``clipmap light`` itself runs, over all of a ground: the same bands, scratch files and shares of 65535, on one thread."""

import tempfile
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from schemas.region import Rect
from schemas.scene import SUN_RADIUS_DEG
from tiler.accuracy.lightground import Ground
from tiler.light.frame import SunPosition
from tiler.light.heights import HeightGrid
from tiler.light.place import GridPlace
from tiler.light.sweeping import Codes
from tiler.light.visibility import TOP, SunSetting, make_shares, sky_shares, sun_shares, whole_zone
from tiler.rowfile import RowFile

_BLOCK: Final = 256


class _GroundGrid(HeightGrid):
    """A ground as the grid that light falls on, without a dataset that it was decoded from."""

    def __init__(self, ground: Ground, scratch: Path) -> None:
        height, width = ground.heights_m.shape
        self.shape, self.block = (height, width), _BLOCK
        self.range_m = float(ground.heights_m.min()), float(ground.heights_m.max())
        self._rows = RowFile(width, height, 1, np.dtype(np.float32), scratch)
        self._rows.write(0, 0, ground.heights_m[..., np.newaxis])


class ShippedLight:
    """Sun and sky over a ``ground`` on a flat Earth, as ``clipmap light --no-curvature`` finds them."""

    def __init__(self, ground: Ground) -> None:
        self._scratch = Path(tempfile.gettempdir())
        self._grid = _GroundGrid(ground, self._scratch)
        cells_m = np.repeat(np.array(ground.cell_m)[:, np.newaxis], ground.heights_m.shape[0], axis=1)
        self._place = GridPlace(cells_m, ground.cell_m, 0.0, 1, None, None)

    def hard(self, sun: SunPosition, lines: int | None) -> Codes:
        """Return 1 where the sun's centre is seen (h, w), else 0; ``lines`` None: ``--certified``."""
        codes: Codes = (self._sun(sun, SunSetting(lines, None, None)) == TOP).view(np.uint8)
        return codes

    def soft(self, sun: SunPosition) -> NDArray[np.float32]:
        """Return the share of the sun's disc that is seen (h, w)."""
        return self._sun(sun, SunSetting(None, SUN_RADIUS_DEG, None)) * np.float32(1 / TOP)

    def sky(self, azimuths: int) -> NDArray[np.float32]:
        """Return the share of an even sky's light that a sample gets (h, w)."""
        return self._all(sky_shares(self._grid, self._place, azimuths, None, 1, self._scratch)) * np.float32(1 / TOP)

    def _sun(self, sun: SunPosition, setting: SunSetting) -> NDArray[np.uint16]:
        shares = make_shares(self._grid, self._scratch)
        sun_shares(self._grid, [whole_zone(self._grid, self._place, sun)], setting, 1, shares)
        return self._all(shares)

    def _all(self, shares: RowFile) -> NDArray[np.uint16]:
        found: NDArray[np.uint16] = shares.read(Rect(0, 0, self._grid.shape[1], self._grid.shape[0]))[..., 0].copy()
        shares.close()
        return found
