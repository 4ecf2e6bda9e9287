"""Whether two runs have left the same bits."""


def assert_same(folder, other):
    """Compare all files of two folders, byte by byte, but for hidden ones, which a killed run may leave."""
    files = [sorted(path.relative_to(one) for path in one.rglob("[!.]*") if path.is_file()) for one in (folder, other)]
    files = [[name for name in names if not name.parts[0].startswith(".")] for names in files]
    assert files[0] == files[1]
    for name in files[0]:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name
