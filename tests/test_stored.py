"""Files of the method's values: what is read is what was written, and anything else is refused by name."""

import json
import os
import struct
from dataclasses import fields, replace

import numpy as np
import pytest
import safetensors.numpy
import torch

from napari_fiberburst import Bundle, Registration, Samples, sample
from napari_fiberburst.errors import BundleError, FiberBurstError, OutputError
from napari_fiberburst.motion.registration import unregistered
from napari_fiberburst.simulation import simulate


@pytest.fixture(scope="module")
def simulated():
    return simulate("cat", shape=(67, 59), frames=2, pitch=5.0, physics="core", channels=1)


@pytest.fixture(scope="module")
def bundle(simulated):
    return Bundle.from_image(np.rint(200 * simulated.transmission).astype(np.uint8), device="cpu")


@pytest.fixture
def kept(bundle, tmp_path):
    return bundle.save(tmp_path / "probe.bundle")


def same_bits(first, second):
    for item in fields(first):
        one, other = getattr(first, item.name), getattr(second, item.name)
        if isinstance(one, np.ndarray | torch.Tensor):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
        else:
            assert one == other or (one != one and other != other), item.name


def test_a_bundle_comes_back_bit_for_bit(bundle, kept):
    same_bits(Bundle.load(kept), bundle)


def test_samples_and_registrations_come_back_bit_for_bit(bundle, simulated, tmp_path):
    samples = sample(simulated.burst, bundle, device="cpu")
    same_bits(Samples.load(samples.save(tmp_path / "samples.safetensors")), samples)
    registration = unregistered(samples)
    same_bits(Registration.load(registration.save(tmp_path / "motion.safetensors")), registration)


def test_the_file_is_of_the_public_format_and_holds_no_pickle(bundle, kept):
    arrays = safetensors.numpy.load_file(kept)
    np.testing.assert_array_equal(arrays["transmission"], bundle.transmission)
    assert b"numpy" not in kept.read_bytes()


def test_arrays_are_views_of_what_was_read(kept):
    read = Bundle.load(kept)
    for array in (read.centres, read.labels, read.transmission, read.gains, read.outline):
        assert not array.flags.owndata
        assert array.flags.aligned


def test_a_value_does_not_change_with_its_file(bundle, kept):
    read = Bundle.load(kept)
    replace(bundle, transmission=bundle.transmission * 0).save(kept)
    np.testing.assert_array_equal(read.transmission, bundle.transmission)


def test_a_file_is_written_whole_or_not_at_all(bundle, kept, monkeypatch):
    before = kept.read_bytes()

    def full(number):
        raise OSError("no space left")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match="no space left"):
        bundle.save(kept)
    assert kept.read_bytes() == before
    assert list(kept.parent.iterdir()) == [kept]


def test_the_ending_says_what_it_is(bundle, tmp_path):
    with pytest.raises(OutputError, match=r"ending in \.bundle"):
        bundle.save(tmp_path / "probe.npz")


def refused(path, said=None):
    """Load, and expect an error that names the file, what was expected, and what to do."""
    with pytest.raises(BundleError, match=said) as error:
        Bundle.load(path)
    message = str(error.value)
    assert str(path) in message
    assert "expected" in message or "digest" in message
    assert any(advice in message for advice in ("again", "another file", "expected a bundle"))


def test_a_file_cut_short_anywhere_is_refused(kept):
    whole = kept.read_bytes()
    for length in (*range(0, 40), *np.linspace(40, len(whole) - 1, 60).astype(int)):
        kept.write_bytes(whole[:length])
        refused(kept)


def test_a_longer_file_is_refused(kept):
    kept.write_bytes(kept.read_bytes() + b"\0" * 64)
    refused(kept, "header tells of")


def test_one_altered_byte_anywhere_is_refused(kept):
    whole = kept.read_bytes()
    header = 8 + struct.unpack("<Q", whole[:8])[0]
    text = len(whole[:header].rstrip())
    places = (*range(0, text, 7), *np.linspace(header, len(whole) - 1, 60).astype(int))
    for place in places:
        kept.write_bytes(whole[:place] + bytes([whole[place] ^ 0x15]) + whole[place + 1 :])
        refused(kept)


@pytest.mark.parametrize("length", [0, 1, 2**31, 2**62, 2**64 - 1])
def test_a_header_of_impossible_size_is_refused_without_reading_it(kept, length):
    kept.write_bytes(struct.pack("<Q", length) + kept.read_bytes()[8:])
    refused(kept, "header is said to have")


def test_other_formats_are_refused(tmp_path):
    path = tmp_path / "probe.bundle"
    for content in (b"", b"\x89PNG\r\n\x1a\n" + bytes(100), b"PK\x03\x04" + bytes(100), b"{}" * 50, b"\xff" * 99):
        path.write_bytes(content)
        refused(path, "is no bundle, or is damaged")
    np.savez(tmp_path / "probe.npz", frames=np.ones(3))
    refused(tmp_path / "probe.npz", "is no bundle, or is damaged")
    safetensors.numpy.save_file({"weight": np.ones((3, 5), np.float32)}, path)
    refused(path, "of format 'unknown'; expected 'napari-fiberburst bundle'")


def test_another_kind_of_value_is_refused(simulated, bundle, tmp_path):
    path = sample(simulated.burst, bundle, device="cpu").save(tmp_path / "samples.safetensors")
    refused(path, "of format 'napari-fiberburst set of samples'")


def rewritten(path, change):
    """Write a file again with its header changed."""
    whole = path.read_bytes()
    length = struct.unpack("<Q", whole[:8])[0]
    header = json.loads(whole[8 : 8 + length])
    text = change(header)
    text = (json.dumps(header) if text is None else text).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + whole[8 + length :])


def test_another_version_is_refused(kept):
    rewritten(kept, lambda header: header["__metadata__"].update(version="7"))
    refused(kept, "version 7; expected version 1; update napari-fiberburst")


@pytest.mark.parametrize(
    "change",
    [
        lambda header: header["__metadata__"].update(values="[" * 100_000),
        lambda header: header.update(__metadata__=[1]),
        lambda header: header["__metadata__"].update(values=3),
        lambda header: header.pop("__metadata__") and None,
        lambda header: header["__metadata__"].update(values='{"provenance": ' + '{"a":' * 500 + "1" + "}" * 501),
        lambda header: '{"__metadata__": ' + '{"a":' * 500 + "1" + "}" * 501,
        lambda header: header["labels"].update(data_offsets=[0]),
        lambda header: header["labels"].update(dtype="F16"),
        lambda header: header["labels"].update(shape=[-1, 3]),
        lambda header: header["labels"].update(shape=[2**62, 2**62]),
        lambda header: header["labels"].update(data_offsets=[0, 2**62]),
        lambda header: header["labels"].update(data_offsets=["a", "b"]),
        lambda header: header.pop("labels") and None,
        lambda header: header.update(labels=header["outline"]),
        lambda header: "[" * 100_000,
        lambda header: "[]",
        lambda header: "7",
    ],
)
def test_a_header_that_makes_no_sense_is_refused(kept, change):
    rewritten(kept, change)
    refused(kept)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda bundle: {"dead": np.zeros((4, 3))}, "dead is float64 of shape"),
        (lambda bundle: {"dead": np.zeros(4)}, "dead"),
        (lambda bundle: {"labels": bundle.labels + len(bundle.centres)}, "labels must lie in"),
        (lambda bundle: {"labels": bundle.labels - 1}, "labels must lie in"),
        (lambda bundle: {"labels": bundle.labels.astype(np.float32)}, "expected int32"),
        (lambda bundle: {"labels": bundle.labels[1:]}, "labels"),
        (lambda bundle: {"transmission": bundle.transmission.ravel()}, "of shape"),
        (lambda bundle: {"transmission": bundle.transmission.astype(np.float64)}, "expected float32"),
        (lambda bundle: {"transmission": bundle.transmission * np.float32("nan")}, "NaN"),
        (lambda bundle: {"centres": bundle.centres[:-1]}, "expected"),
        (lambda bundle: {"centres": bundle.centres / 0.0}, "infinity"),
        (lambda bundle: {"gains": -bundle.gains}, "positive"),
        (lambda bundle: {"gains": bundle.gains[:, :0]}, "gains"),
        (lambda bundle: {"gains": bundle.gains[:, 0]}, "gains"),
        (lambda bundle: {"gain_weights": -bundle.gain_weights - 1}, "not negative"),
        (lambda bundle: {"offsets": bundle.offsets * np.float32("inf")}, "NaN or infinity"),
        (lambda bundle: {"saturated": bundle.saturated.astype(np.uint8)}, "expected bool"),
        (lambda bundle: {"outline": bundle.outline[:, 1:]}, "outline"),
        (lambda bundle: {"pitch": 0.0}, "pitch"),
        (lambda bundle: {"pitch": "wide"}, "holds no complete bundle"),
        (lambda bundle: {"radius": float("inf")}, "radius"),
        (lambda bundle: {"black": float("nan")}, "black"),
        (lambda bundle: {"pattern": "stripes"}, "pattern must be one of"),
        (lambda bundle: {"provenance": 3}, "provenance"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero", "ignore:invalid value")
def test_contents_that_do_not_belong_together_are_refused(bundle, tmp_path, change, said):
    path = replace(bundle, **change(bundle)).save(tmp_path / "probe.bundle")
    refused(path, said)


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.bundle").mkdir()
    os.mkfifo(tmp_path / "pipe.bundle")
    for name in ("none.bundle", "folder.bundle", "pipe.bundle", "a\0b.bundle", "x" * 400 + ".bundle"):
        refused(tmp_path / name)


def test_a_file_that_may_not_be_read_is_refused(kept, monkeypatch):
    def denied(*arguments, **more):
        raise PermissionError("permission denied")

    monkeypatch.setattr(type(kept), "open", denied)
    refused(kept, "permission denied")


def test_errors_are_of_this_package():
    assert issubclass(BundleError, FiberBurstError)
