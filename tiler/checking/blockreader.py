"""Reading blocks back as samples: stored bytes, checked against the index, decoded with the layer's codec."""

from dataclasses import dataclass

import numpy as np

from schemas.address import BlockAddress
from schemas.errors import InputError, UsageError
from schemas.manifest import digest
from tiler.codecs import BlockFormat, Codec, Mask, Samples, open_codec
from tiler.stores.dataset import Dataset


@dataclass(frozen=True, slots=True)
class DecodedBlock:
    """Samples (rows, columns, channels) and which of them are valid (rows, columns): not void, not fully transparent."""

    samples: Samples
    valid: Mask


class BlockReader:
    """Decodes the blocks of one layer; safe to use from several threads.

    Raises InputError if the layer's codec is unknown or cannot hold what the manifest says.
    """

    def __init__(self, dataset: Dataset, name: str) -> None:
        self.dataset, self.name = dataset, name
        self.layer = layer = dataset.manifest.layer(name)
        self.lattice = layer.lattice
        self.block = BlockFormat(layer.kind, self.lattice.stored_side, layer.channels, layer.dtype, layer.alpha)
        try:
            self.codec: Codec = open_codec(layer.codec, self.block)
        except UsageError as error:
            raise InputError(f"{dataset.store.location}: the blocks of layer {name!r} cannot be decoded: {error}") from error

    def decode(self, data: bytes) -> DecodedBlock:
        """Return all samples of a block, pad included; raises InputError if ``data`` is damaged."""
        samples, mask = self.codec.decode(data)
        if self.block.alpha:
            return DecodedBlock(samples, samples[..., -1] > 0)
        return DecodedBlock(samples, np.ones(samples.shape[:2], np.bool_) if mask is None else mask)

    def core(self, address: BlockAddress, whole: DecodedBlock) -> DecodedBlock:
        """Return the core of a decoded block, without its pad and without padding beyond the level."""
        inside, pad = self.lattice.valid_core(address), self.lattice.pad
        window = np.s_[pad : pad + inside.height, pad : pad + inside.width]
        return DecodedBlock(whole.samples[window], whole.valid[window])

    def read_core(self, address: BlockAddress) -> DecodedBlock | None:
        """Return the core of a stored block, None for a blank.

        Raises NotFoundError if the block is missing or outside the lattice, InputError if it is damaged.
        """
        data = self.dataset.block(self.name, address)
        if data is None:
            return None
        where = f"{self.dataset.store.location}/{self.layer.block_key(self.name, address)}"
        if digest(data) != self.dataset.record(self.name, address).digest:
            raise InputError(f"{where}: differs from the digest in the index; the block is damaged, rebuild the layer")
        try:
            return self.core(address, self.decode(data))
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
