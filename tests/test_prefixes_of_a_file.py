"""The commands that cut a file, or read a part of one."""

import json
from pathlib import Path

import pytest

from splatwizard_core.api import parse_size
from splatwizard_core.cli.main import main

GOLDEN = Path(__file__).parent / "golden"
PACKETS = GOLDEN / "3dgs_packets_v1.swz"
FACTS = json.loads((GOLDEN / "golden.json").read_text())["3dgs_packets_v1"]


def told(capsys, *arguments) -> dict:
    assert main([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def refused(capsys, *arguments) -> str:
    assert main([*map(str, arguments)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_info_names_the_cuts(capsys):
    facts = told(capsys, "info", PACKETS)
    assert [cut["packets"] for cut in facts["cuts"]] == [1, 2, 3, 4]
    assert facts["cuts"][-1] == {"packets": 4, "bytes": FACTS["bytes"], "psnr": None}
    assert (facts["packets"], facts["container_version"]) == (4, 2)
    assert main(["info", str(PACKETS)]) == 0
    text = capsys.readouterr().out
    assert all(f"{cut['bytes']:,}" in text for cut in facts["cuts"])
    assert "ends after" not in text
    assert "PSNR" not in text  # of which this file has none


def test_a_truncated_file_is_a_file_and_decodes_like_the_first_packets(capsys, tmp_path):
    short, cuts = tmp_path / "short.swz", told(capsys, "info", PACKETS)["cuts"]
    for packets in (1, 3):
        size = cuts[packets - 1]["bytes"]
        done = told(capsys, "truncate", PACKETS, "--packets", packets, "--out", short)
        assert done == {"file": str(short), "packets": packets, "bytes": size}
        assert short.read_bytes() == PACKETS.read_bytes()[:size]
        expected = told(capsys, "decode", short, "--repeats", 0)
        assert (expected["packets"], expected["bytes"]) == (packets, size)
        for part in (("--packets", packets), ("--bytes", size), ("--bytes", f"{size / 1000 + 0.01:.3f}kB")):
            found = told(capsys, "decode", PACKETS, *part, "--repeats", 0)
            assert (found["digest"], found["bytes"]) == (expected["digest"], size)
    assert main(["info", str(short)]) == 0
    assert "the file ends after packet 3 of 4" in capsys.readouterr().out
    assert main(["decode", str(short), "--repeats", "0"]) == 0
    assert f"3 packets, {cuts[2]['bytes']:,} bytes" in capsys.readouterr().out


def test_a_size_takes_the_longest_cut_that_fits(capsys, tmp_path):
    cuts = told(capsys, "info", PACKETS)["cuts"]
    for size, packets in ((f"{cuts[1]['bytes']}", 2), (f"{cuts[1]['bytes'] - 1}B", 1), ("1MB", 4)):
        done = told(capsys, "truncate", PACKETS, "--size", size, "--out", tmp_path / "short.swz")
        assert done["packets"] == packets
    error = refused(capsys, "truncate", PACKETS, "--size", "0.1kB", "--out", tmp_path / "none.swz")
    assert f"first packet ends at {cuts[0]['bytes']:,} bytes" in error
    assert "'half' is no size" in refused(capsys, "truncate", PACKETS, "--size", "half", "--out", tmp_path / "n.swz")
    assert not (tmp_path / "none.swz").exists()


def test_what_ends_at_no_cut_is_truncated_and_partial_takes_what_is_whole(capsys, caplog, tmp_path):
    broken, cuts = tmp_path / "broken.swz", told(capsys, "info", PACKETS)["cuts"]
    broken.write_bytes(PACKETS.read_bytes()[: cuts[2]["bytes"] - 1])
    for command in (("decode", broken), ("truncate", broken, "--packets", 1, "--out", tmp_path / "x.swz")):
        error = refused(capsys, *command)
        assert "truncated" in error
        assert f"--partial of `sw decode` or `sw truncate` takes packet 2 ({cuts[1]['bytes']:,} bytes)" in error
    whole = told(capsys, "decode", PACKETS, "--packets", 2, "--repeats", 0)
    assert told(capsys, "decode", broken, "--partial", "--repeats", 0)["digest"] == whole["digest"]
    missing = cuts[3]["bytes"] - cuts[2]["bytes"] + 1
    assert f"2 of 4 packets are there, {missing:,} bytes are missing" in caplog.text
    assert "another file than the source" in refused(capsys, "truncate", broken, "--partial", "--out", broken)
    mended = tmp_path / "mended.swz"
    told(capsys, "truncate", broken, "--partial", "--out", mended)
    assert told(capsys, "decode", mended, "--repeats", 0)["digest"] == whole["digest"]


def test_partial_leaves_out_what_follows_the_last_packet(capsys, caplog, tmp_path):
    longer = tmp_path / "longer.swz"
    longer.write_bytes(PACKETS.read_bytes() + b"more")
    assert "4 bytes follow the last section" in refused(capsys, "decode", longer)
    whole = told(capsys, "decode", PACKETS, "--repeats", 0)
    assert told(capsys, "decode", longer, "--partial", "--repeats", 0)["digest"] == whole["digest"]
    assert "longer.swz: 4 of 4 packets are there, 4 bytes behind them are left out" in caplog.text
    assert "missing" not in caplog.text


def test_eval_measures_each_prefix_as_the_file_that_ends_there(capsys, tmp_path):
    options = ("--scene", "demo:tiny", "--no-speed", "--quiet", "--metrics", "psnr")
    found = told(capsys, "eval", PACKETS, *options, "--prefixes")
    cuts = told(capsys, "info", PACKETS)["cuts"]
    assert [(each["packets"], each["bytes"]) for each in found["prefixes"]] == [
        (c["packets"], c["bytes"]) for c in cuts
    ]
    assert found["prefixes"][-1]["metrics"] == {"psnr": found["metrics"]["psnr"]["mean"]}
    assert found["prefixes"][-1]["counts"] == found["counts"]
    short = tmp_path / "short.swz"
    short.write_bytes(PACKETS.read_bytes()[: cuts[1]["bytes"]])
    alone = told(capsys, "eval", short, *options, "--prefixes")
    assert alone["prefixes"] == found["prefixes"][:2]
    assert alone["metrics"]["psnr"]["mean"] == found["prefixes"][1]["metrics"]["psnr"]
    plain = told(capsys, "eval", GOLDEN / "3dgs_r3_v1.swz", *options, "--prefixes")
    assert plain["prefixes"] == told(capsys, "eval", PACKETS, *options)["prefixes"] == []


def test_a_file_without_cuts_is_not_cut(capsys, caplog, tmp_path):
    plain, out = GOLDEN / "3dgs_r3_v1.swz", tmp_path / "x.swz"
    assert "declares no cuts" in refused(capsys, "truncate", plain, "--packets", 1, "--out", out)
    assert "declares no cuts" in refused(capsys, "truncate", plain, "--partial", "--out", out)
    assert "declares no cuts" in refused(capsys, "decode", plain, "--bytes", "1MB")
    assert "give --packets P, --size SIZE or --partial" in refused(capsys, "truncate", PACKETS, "--out", out)
    assert "4 packets, 5 are asked for" in refused(capsys, "decode", PACKETS, "--packets", 5)
    assert not out.exists()
    assert told(capsys, "decode", plain, "--partial", "--repeats", 0)["packets"] == 0
    assert "it declares no cuts, so that --partial is of no use to it" in caplog.text


@pytest.mark.parametrize(
    ("size", "meant"),
    [("500", 500), (" 5 kB", 5000), ("1.5mb", 1_500_000), (".5GB", 500_000_000), ("2k", 2000), ("8KiB", 8192),
     ("8MiB", 8 << 20), ("1gib", 1 << 30), ("12b", 12), (7, 7)],
)  # fmt: skip
def test_a_size_is_decimal_or_binary(size, meant):
    assert parse_size(size) == meant


@pytest.mark.parametrize("size", ["", "-1", "1e9", "5 pounds", "kB", "0.1B", "2000000GB", "9" * 99])
def test_what_is_no_size_is_refused(capsys, size):
    assert "is no size" in refused(capsys, "decode", PACKETS, "--bytes", size)
