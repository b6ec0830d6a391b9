"""The contract of a block codec, run over every codec and every format of blocks it accepts."""

from concurrent.futures import ThreadPoolExecutor

import imagecodecs
import numpy as np
import pytest

from schemas.errors import InputError, UsageError
from schemas.manifest import SampleType
from tests.contract.blocks import BOUNDED, CASES, LOSSLESS, Case, heights, imagery, ulp
from tests.reference.terrain import photo
from tiler.codecs import CODEC_NAMES, BlockFormat, Mask, Samples, open_codec

HEIGHT = BlockFormat("height", 64, 1, "float32")


def picture(channels: int, dtype: SampleType = "uint8", side: int = 64) -> BlockFormat:
    return BlockFormat("imagery", side, channels, dtype, alpha=channels in (2, 4))


def same(left: Samples, right: Samples) -> bool:
    """Whether all samples are the same bits: -0.0 is not 0.0."""
    return left.dtype == right.dtype and left.shape == right.shape and left.tobytes() == right.tobytes()


def masks_equal(left: Mask | None, right: Mask | None) -> bool:
    return left is right if left is None or right is None else np.array_equal(left, right)


def test_every_codec_is_under_contract() -> None:
    assert {case.spec.partition(":")[0] for case in CASES} == set(CODEC_NAMES)


@pytest.mark.parametrize("case", CASES, ids=str)
class TestContract:
    def test_round_trip(self, case: Case) -> None:
        codec = case.open()
        for samples, mask in case.blocks():
            decoded, decoded_mask = codec.decode(codec.encode(samples, mask))
            assert decoded.shape == samples.shape
            assert decoded.dtype == samples.dtype
            assert masks_equal(decoded_mask, None if mask is None or mask.all() else mask)
            if decoded_mask is not None:
                assert decoded_mask.dtype == np.bool_
                assert not decoded[~decoded_mask].any(), "voids must decode to 0"

    def test_promise(self, case: Case) -> None:
        codec = case.open()
        if codec.max_error is None:
            assert case.spec not in LOSSLESS + BOUNDED
            return
        for samples, mask in case.blocks():
            decoded, _ = codec.decode(codec.encode(samples, mask))
            valid = np.ones(samples.shape[:2], np.bool_) if mask is None else mask
            if codec.max_error == 0:
                # LERC stores a constant part as one number, which may be either zero.
                assert same(decoded[valid], samples[valid]) or (codec.suffix == "lerc" and np.array_equal(decoded[valid], samples[valid]))
            else:
                error = np.abs(decoded[valid].astype(np.float64) - samples[valid].astype(np.float64))
                assert (error <= codec.max_error + (ulp(samples[valid]) / 2 if case.rounds_twice else 0)).all(), error.max()

    def test_same_block_same_bytes(self, case: Case) -> None:
        samples, mask = case.blocks()[0]
        first = case.open().encode(samples, mask)
        codec = case.open()
        with ThreadPoolExecutor(4) as pool:
            assert set(pool.map(lambda _: codec.encode(samples, mask), range(8))) == {first}
            assert all(same(decoded, codec.decode(first)[0]) for decoded, _ in pool.map(lambda _: codec.decode(first), range(8)))

    def test_samples_need_not_lie_together_in_memory(self, case: Case) -> None:
        samples, mask = case.blocks()[0]
        wide = np.zeros((samples.shape[0], samples.shape[1] * 2, samples.shape[2]), samples.dtype)
        wide[:, ::2] = samples
        codec = case.open()
        assert codec.encode(wide[:, ::2], mask) == codec.encode(samples, mask)

    def test_decoded_samples_can_be_written_to(self, case: Case) -> None:
        codec = case.open()
        for samples, mask in case.blocks()[:2]:
            codec.decode(codec.encode(samples, mask))[0][:] = 0

    def test_what_lies_under_voids_cannot_be_seen(self, case: Case) -> None:
        if case.block.dtype != "float32":
            return
        rng = np.random.default_rng(5)
        samples = np.repeat(heights(case.block.side, offset=500), case.block.channels, axis=-1)
        mask = rng.random(samples.shape[:2]) < 0.7
        buried = samples.copy()
        buried[~mask] = rng.choice(np.array([np.nan, np.inf, -np.inf, 3e38, -32768], np.float32), (np.count_nonzero(~mask), 1))
        codec = case.open()
        assert codec.encode(buried, mask) == codec.encode(samples, mask)

    def test_a_mask_of_all_valid_is_no_mask(self, case: Case) -> None:
        if case.block.kind == "height":
            samples, codec = heights(case.block.side, offset=500), case.open()
            assert codec.encode(samples, np.ones(samples.shape[:2], np.bool_)) == codec.encode(samples, None)

    def test_imagery_carries_its_mask_as_alpha(self, case: Case) -> None:
        if case.block.dtype != "float32":
            with pytest.raises(UsageError, match="mask"):
                case.open().encode(case.blocks()[0][0], np.ones((case.block.side, case.block.side), np.bool_))

    def test_cut_off_bytes_are_refused(self, case: Case, capfd: pytest.CaptureFixture[str]) -> None:
        """And no library has its own say about it on the terminal."""
        codec = case.open()
        for samples, mask in case.blocks()[:2]:
            data = codec.encode(samples, mask)
            middle = range(64, len(data) - 32, max(1, len(data) // 20))
            lengths = {*range(min(64, len(data))), *middle, *range(max(0, len(data) - 32), len(data))}
            # Raw samples without their mask are a block without voids; the block index knows the length that was stored.
            lengths -= {samples.nbytes} if case.spec == "raw" else set()
            for length in lengths:
                with pytest.raises(InputError, match="damaged") as caught:
                    codec.decode(data[:length])
                assert "\n" not in str(caught.value)
        assert capfd.readouterr() == ("", "")

    def test_garbage_is_refused(self, case: Case) -> None:
        rng = np.random.default_rng(3)
        for data in (b"", b"\0", b"<html>", rng.bytes(100), rng.bytes(5000)):
            with pytest.raises(InputError, match="damaged"):
                case.open().decode(data)

    def test_flipped_bits_are_refused_or_decode_to_a_block(self, case: Case) -> None:
        """A format without check sums cannot notice a flipped bit, but what comes out is a block all the same."""
        rng = np.random.default_rng(4)
        codec = case.open()
        samples, mask = case.blocks()[0]
        data = codec.encode(samples, mask)
        for place in (*range(min(64, len(data))), *rng.integers(0, len(data), 32)):
            damaged = bytearray(data)
            damaged[place] ^= 1 << int(rng.integers(8))
            try:
                decoded, decoded_mask = codec.decode(bytes(damaged))
            except InputError:
                continue
            assert decoded.shape == samples.shape
            assert decoded.dtype == samples.dtype
            assert decoded_mask is None or decoded_mask.shape == samples.shape[:2]

    def test_a_block_of_another_size_is_refused(self, case: Case) -> None:
        samples, mask = case.blocks()[0]
        data = case.open().encode(samples, mask)
        for side in (case.block.side // 2, case.block.side * 2, 4096):
            other = BlockFormat(case.block.kind, side, case.block.channels, case.block.dtype, case.block.alpha)
            with pytest.raises(InputError, match="damaged"):
                open_codec(case.spec, other).decode(data)

    def test_spec_is_canonical(self, case: Case) -> None:
        codec = case.open()
        again = open_codec(codec.spec, case.block)
        assert again.spec == codec.spec
        assert (again.suffix, again.media_type, again.max_error) == (codec.suffix, codec.media_type, codec.max_error)
        assert codec.suffix.isalnum()
        assert "/" in codec.media_type
        samples, mask = case.blocks()[0]
        assert again.encode(samples, mask) == codec.encode(samples, mask)


@pytest.mark.parametrize(
    ("spec", "canonical"),
    [
        ("jpeg", "jpeg:85"),
        ("jpeg:090", "jpeg:90"),
        ("webp", "webp:85"),
        ("png", "png"),
        ("rgb565", "rgb565"),
        ("raw", "raw"),
    ],
)
def test_defaults_of_imagery_are_spelled_out(spec: str, canonical: str) -> None:
    assert open_codec(spec, picture(3)).spec == canonical


@pytest.mark.parametrize(
    ("spec", "canonical"),
    [
        ("lerc", "lerc:0.01"),
        ("lerc:0.0100", "lerc:0.01"),
        ("lerc:1e-2", "lerc:0.01"),
        ("lerc:0", "lerc:0"),
        ("lerc:0.0123456789", "lerc:0.0123456789"),
        ("png16:0.10,-500.0", "png16:0.1,-500"),
        ("png16:0.123456789,-10898.123456", "png16:0.123456789,-10898.123456"),
        ("exr", "exr:float"),
        ("exr:half", "exr:half"),
    ],
)
def test_parameters_of_heights_are_kept_exactly(spec: str, canonical: str) -> None:
    """The manifest keeps the string: a scale cut to six digits would move every height of the dataset."""
    assert open_codec(spec, HEIGHT).spec == canonical


@pytest.mark.parametrize(
    ("spec", "block"),
    [
        ("jpg", picture(3)),
        ("", picture(3)),
        ("JPEG", picture(3)),
        ("jpeg:0", picture(3)),
        ("jpeg:101", picture(3)),
        ("jpeg:85.5", picture(3)),
        ("jpeg:x", picture(3)),
        ("jpeg:-1", picture(3)),
        ("jpeg:²", picture(3)),
        ("jpeg", picture(4)),
        ("jpeg", picture(2)),
        ("jpeg", picture(3, "uint16")),
        ("jpeg", HEIGHT),
        ("png:9", picture(3)),
        ("png", HEIGHT),
        ("webp:200", picture(3)),
        ("webp", picture(1)),
        ("webp", picture(3, "uint16")),
        ("webp", BlockFormat("normal", 64, 3, "uint8", alpha=True)),
        ("webp", BlockFormat("light", 64, 1, "uint16")),
        ("exr", BlockFormat("height", 64, 2, "float32")),
        ("webp", HEIGHT),
        ("rgb565:1", picture(3)),
        ("rgb565", picture(4)),
        ("rgb565", picture(1)),
        ("rgb565", HEIGHT),
        ("raw:1", picture(3)),
        ("lerc", picture(3)),
        ("lerc", picture(1)),
        ("lerc:-1", HEIGHT),
        ("lerc:nan", HEIGHT),
        ("lerc:inf", HEIGHT),
        ("lerc:1m", HEIGHT),
        ("png16", HEIGHT),
        ("png16:0.1", HEIGHT),
        ("png16:,5", HEIGHT),
        ("png16:0,0", HEIGHT),
        ("png16:-1,0", HEIGHT),
        ("png16:1,2,3", HEIGHT),
        ("png16:1,0", picture(1, "uint16")),
        ("exr:double", HEIGHT),
        ("exr", picture(1)),
    ],
)
def test_wrong_requests_are_refused_in_one_sentence(spec: str, block: BlockFormat) -> None:
    with pytest.raises(UsageError) as caught:
        open_codec(spec, block)
    assert "\n" not in str(caught.value)
    assert "codec" in str(caught.value)


@pytest.mark.parametrize("error_m", [0.001, 0.01, 0.25, 1.0])
@pytest.mark.parametrize("offset", [0.0, 8848.0, -10898.0, 1e5])
def test_lerc_keeps_its_bound_at_any_height(error_m: float, offset: float) -> None:
    codec = open_codec(f"lerc:{error_m}", HEIGHT)
    rng = np.random.default_rng(int(abs(offset)))
    for spread in (0.005, 1.0, 300.0, 9000.0):
        samples = (offset + spread * rng.standard_normal((64, 64, 1))).astype(np.float32)
        decoded, _ = codec.decode(codec.encode(samples, None))
        assert np.abs(decoded.astype(np.float64) - samples.astype(np.float64)).max() <= error_m


def test_lerc_takes_fewer_bytes_for_a_wider_bound() -> None:
    samples = heights(256)
    sizes = [
        len(open_codec(f"lerc:{bound}", BlockFormat("height", 256, 1, "float32")).encode(samples, None)) for bound in (0, 0.01, 0.1, 1)
    ]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] < sizes[0] / 2


def test_jpeg_size_grows_with_quality() -> None:
    samples = photo(256, 256)
    sizes = [len(open_codec(f"jpeg:{quality}", picture(3, side=256)).encode(samples, None)) for quality in (1, 25, 50, 75, 85, 95, 100)]
    assert sizes == sorted(set(sizes))


@pytest.mark.parametrize(("spec", "worst", "mean"), [("jpeg:95", 40, 4), ("jpeg:85", 80, 9), ("webp:95", 80, 9)])
def test_lossy_codecs_keep_the_picture(spec: str, worst: int, mean: float) -> None:
    samples = photo(256, 256)
    codec = open_codec(spec, picture(3, side=256))
    error = np.abs(codec.decode(codec.encode(samples, None))[0].astype(int) - samples)
    assert error.max() <= worst
    assert error.mean() <= mean


def test_webp_keeps_alpha_exactly_also_where_it_is_opaque_everywhere() -> None:
    codec = open_codec("webp:50", picture(4))
    samples = imagery(64, 4, "uint8")
    for alpha in (samples[..., 3], np.full((64, 64), 255), np.full((64, 64), 254), np.zeros((64, 64))):
        samples[..., 3] = alpha
        assert np.array_equal(codec.decode(codec.encode(samples, None))[0][..., 3], alpha)


def test_light_in_webp_is_grey_to_everyone() -> None:
    """Three equal channels, to a code: WebP has no grey. Its error is that of JPEG of the same quality, and its alpha is exact."""
    grey = photo(256, 256)[..., :1]
    alpha = np.random.default_rng(3).choice(np.array([0, 255], np.uint8), grey.shape)
    for samples in (grey, np.concatenate([grey, alpha], axis=-1)):
        codec = open_codec("webp:90", BlockFormat("light", 256, samples.shape[2], "uint8", alpha=samples.shape[2] == 2))
        data = codec.encode(samples, None)
        decoded = codec.decode(data)[0].astype(int)
        assert np.abs(decoded - samples)[alpha[..., 0] == 255, 0].mean() < 3
        assert np.array_equal(decoded[..., 1:], samples[..., 1:])
        seen = imagecodecs.webp_decode(data)[..., :3].astype(int)
        assert np.abs(seen - seen[..., 1:2]).max() <= 1


def test_rgb565_errs_by_four_codes_in_red_and_blue_and_two_in_green() -> None:
    """All 256 values of each channel: the texel is the nearest one, and a GPU's expansion of it is what we decode."""
    codec = open_codec("rgb565", picture(3, side=16))
    ramp = np.arange(256, dtype=np.uint8).reshape(16, 16)
    decoded = codec.decode(codec.encode(np.stack([ramp] * 3, axis=-1), None))[0].astype(int)
    error = np.abs(decoded - ramp[..., np.newaxis])
    assert error.reshape(-1, 3).max(axis=0).tolist() == [4, 2, 4]
    assert codec.max_error == 4
    for channel, top in enumerate((31, 63, 31)):
        expected = np.floor(np.arange(256) * top / 255 + 0.5)
        assert np.array_equal(np.unique(decoded[..., channel]).size, top + 1)
        assert np.array_equal(np.rint(decoded[..., channel].ravel() * top / 255), expected)


def test_rgb565_lays_red_into_the_high_bits() -> None:
    codec = open_codec("rgb565", picture(3, side=2))
    samples = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    assert codec.encode(samples, None).hex() == "00f8e0071f00ffff"


def test_raw_is_little_endian_whatever_the_machine() -> None:
    samples = np.array([[[1], [256]], [[65535], [0]]], np.uint16)
    assert open_codec("raw", picture(1, "uint16", 2)).encode(samples, None).hex() == "01000001ffff0000"
    block = BlockFormat("height", 2, 1, "float32")
    ones = np.ones((2, 2, 1), np.float32)
    mask = np.array([[True, False], [False, True]])
    assert open_codec("raw", block).encode(ones, mask).hex() == "0000803f00000000000000000000803f" + "09"


@pytest.mark.parametrize("height", [-500.1, 6053.6, 1e30])
def test_png16_refuses_heights_beyond_its_range(height: float) -> None:
    codec = open_codec("png16:0.1,-500", HEIGHT)
    assert codec.value_range == pytest.approx((-500, 6053.5))
    samples = heights(64)
    samples[5, 7] = height
    with pytest.raises(InputError, match=r"codec png16:0\.1,-500 holds heights from -500 to 6053.5 m only"):
        codec.encode(samples, None)
    mask = np.ones((64, 64), np.bool_)
    mask[5, 7] = False
    codec.encode(samples, mask)


def test_png16_of_whole_steps_is_lossless() -> None:
    codec = open_codec("png16:1,-32768", BlockFormat("height", 256, 1, "float32"))
    samples = np.arange(-32768, 32768, dtype=np.float32).reshape(256, 256, 1)
    assert same(codec.decode(codec.encode(samples, None))[0], samples)


def test_exr_half_refuses_what_it_cannot_hold_and_rounds_the_rest() -> None:
    codec = open_codec("exr:half", HEIGHT)
    samples = heights(64)
    decoded, _ = codec.decode(codec.encode(samples, None))
    assert np.array_equal(decoded, samples.astype(np.float16).astype(np.float32))
    samples[0, 0] = 65504
    codec.encode(samples, None)
    samples[0, 0] = 65505
    with pytest.raises(InputError, match="use exr:float"):
        codec.encode(samples, None)
    mask = np.ones((64, 64), np.bool_)
    mask[0, 0] = False
    codec.encode(samples, mask)
