"""Whether two runs have left the same bits."""


def assert_same(folder, other):
    """Compare all files of two folders, byte by byte."""
    files = [sorted(path.relative_to(one) for path in one.rglob("*") if path.is_file()) for one in (folder, other)]
    assert files[0] == files[1]
    for name in files[0]:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
