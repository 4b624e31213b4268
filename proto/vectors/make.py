#!/usr/bin/env python3
"""Makes the example messages beside this file, with NumPy and msgpack only: nothing here comes from the program.

  make.py           write the messages and vectors.json
  make.py --check   compare them with what is there, and the headers with tile.schema.json (needs jsonschema)

vectors.json: each message with what it shows; "kind" is "tile" (a tile stream) or "result" (a result stream); a bad one
has the "code" of its error; a good tile stream has its "tiles": core, number of samples, counts (if they vary) and the
planes' values as they are on the wire, widened to f32, before anything is replaced ("nan", "inf", "-inf" in words).
"""
import json
import math
import struct
import sys
from pathlib import Path

import msgpack
import numpy as np

HERE = Path(__file__).resolve().parent


def pack(value):
    return msgpack.packb(value, use_bin_type=True)


class Single(float):
    """A float to be written in 32 bits."""


def pack_plane(value, dtype):
    if isinstance(value, bytes):
        return value
    if isinstance(value, Single):
        return b"\xca" + struct.pack(">f", value)
    if isinstance(value, (int, float)):
        return pack(value)
    with np.errstate(over="ignore"):
        return pack(np.asarray(value, dtype).tobytes())


def dtypes(header):
    for channel in header["channels"]:
        short = channel.get("format", header["format"]) == "f16" and channel["role"] != "film"
        yield from ["<f2" if short else "<f4"] * channel["components"]


def tile(header, planes, counts=None):
    out = pack(header)
    if counts is not None:
        out += pack(np.asarray(counts, "<u2").tobytes())
    return out + b"".join(pack_plane(p, d) for p, d in zip(planes, dtypes(header), strict=True))


def words(value):
    value = float(value)
    return "nan" if math.isnan(value) else value if math.isfinite(value) else "inf" if value > 0 else "-inf"


def expected(header, planes, counts=None):
    x, y, w, h = header["tile"]
    l, t, r, b = header["halo"]
    total = sum(counts) if counts is not None else (w + l + r) * (h + t + b) * header["samples"]
    values = []
    for plane, dtype in zip(planes, dtypes(header), strict=True):
        with np.errstate(over="ignore"):
            plane = np.array([plane] * total if isinstance(plane, (int, float)) else plane, dtype)
        values.append([words(v) for v in plane.astype(np.float32)])
    out = {"tile": header["tile"], "samples": total, "planes": values}
    return out if counts is None else {**out, "counts": counts}


COLOR = {"name": "color", "role": "color", "components": 3}
FILM = {"name": "film", "role": "film", "components": 2}
POSITION = {"name": "P", "role": "feature", "components": 3, "space": "position"}
DEPTH = {"name": "depth", "role": "feature", "components": 1}
LENS = {"name": "lens", "role": "random", "components": 2}
DIRECTION = {"name": "direction", "role": "random", "components": 1, "uniform": False}


def header(**changes):
    base = {"type": "tile", "version": 1, "image": [4, 3], "tile": [0, 0, 2, 1], "halo": [0, 0, 0, 0],
            "samples": 2, "format": "f32", "channels": [COLOR]}
    base.update(changes)
    return {k: v for k, v in base.items() if v is not None}


def ramp(n, start=0.0):
    return [start + 0.25 * i for i in range(n)]


RGB = [ramp(4), ramp(4, 1), ramp(4, 2)]


def good_tiles():
    full = [FILM, COLOR, POSITION, DEPTH, LENS, DIRECTION]
    # Core of 2 x 1 at (1, 1) with a halo of one pixel: a window of 4 x 3, 2 samples each.
    planes = [ramp(24, k) for k in range(12)]
    yield "all_roles_f32", "every role, a halo, all planes spelt out", \
        [(header(tile=[1, 1, 2, 1], halo=[1, 1, 1, 1], channels=full), planes)]
    yield "all_roles_f16", "f16, the film position f32 all the same", \
        [(header(tile=[1, 1, 2, 1], halo=[1, 1, 1, 1], channels=full, format="f16"), planes)]
    own = [FILM, {**COLOR, "format": "f32"}, {**POSITION, "format": "f16"}]
    yield "own_formats", "formats of the channels' own", [(header(channels=own, format="f16"), [ramp(4, 0.1)] * 8)]
    lens = [COLOR, {"name": "lens", "role": "random", "components": 4}]
    numbers = [7, -3, 1.0 + 2.0 ** -11 + 2.0 ** -40, Single(0.1), math.nan, 2 ** 40, 65504]
    for fmt in ("f32", "f16"):
        yield f"constants_{fmt}", "constants of every type, rounded once to the plane's format", \
            [(header(channels=lens, format=fmt), numbers)]
    yield "not_finite", "NaN and infinities, as they are before anything is replaced", \
        [(header(channels=[COLOR, DEPTH]), [[math.nan, 1, 2, 3], [0, math.inf, 1, 2], [-math.inf, 0, 0, 0], [math.nan] * 4])]
    yield "f16_overflow", "values beyond f16 become infinite", [(header(format="f16"), [[65504, 65519, 65520, 1e9]] + RGB[1:])]
    yield "varying", "counts ahead of the planes, one of them 0", \
        [(header(samples="varying", total=3, tile=[0, 0, 3, 1]), [[1, 2, 3], [4, 5, 6], [7, 8, 9]], [1, 0, 2])]
    yield "varying_empty", "no samples at all, planes as empty bins and as constants", \
        [(header(samples="varying", total=0), [[], 5, []], [0, 0])]
    yield "no_samples", "0 samples a pixel", [(header(samples=0), [[], [], 1.5])]
    yield "own_keys", "keys of the writer's own are carried along", \
        [({**header(), "x-camera": {"fov": 40, "lens": [1, [2, [3]]]}, "x-": None}, RGB)]
    yield "two_tiles", "a stream of two tiles, the second in the image's last corner", \
        [(header(), RGB), (header(tile=[2, 2, 2, 1]), [ramp(4, 9), 0.5, 0])]
    yield "long_names", "names of 255 bytes, keys in another order", \
        [(dict(reversed(header(channels=[{**COLOR, "name": "c" * 252 + "\u20ac"}]).items())), RGB)]


def bad_tiles():
    whole = tile(header(), RGB)
    yield "empty", "no bytes at all", b"", "empty"
    for name, cut in (("in_header", 40), ("in_plane", len(whole) - 5), ("ahead_of_plane", len(pack(header())))):
        yield f"truncated_{name}", "ends too early", whole[:cut], "truncated"
    yield "trailing_plane", "one plane more than announced", whole + pack(b"1234"), "trailing"
    yield "trailing_bytes", "something after the last plane", whole + b"\x00\x00", "trailing"
    yield "not_messagepack_map", "JSON", b'{"type": "tile"}', "not_a_tile"
    yield "zstd", "compressed without saying so", b"\x28\xb5\x2f\xfd\x00\x58", "not_a_tile"
    yield "other_type", "a message of another type", tile(header(type="image"), RGB), "not_a_tile"
    yield "reserved_marker", "the byte that starts no object", whole.replace(b"\xa4tile\xa7", b"\xc1tile\xa7", 1), "malformed"
    yield "text_not_utf8", "a key that is no text", whole.replace(b"\xa4halo", b"\xa4h\xff\xfeo", 1), "malformed"
    yield "version_2", "another version, with keys of its own", tile(header(version=2, colour="yes"), RGB), "version"
    yield "version_text", "a version in words", tile(header(version="1"), RGB), "wrong_type"
    yield "unknown_key", "a misspelt key", tile({**header(), "sampels": 2}, RGB), "unknown_key"
    yield "total_without_varying", "a total that goes with nothing", tile(header(total=4), RGB), "unknown_key"
    yield "unknown_channel_key", "a key of another role", \
        tile(header(channels=[{**COLOR, "space": "other"}]), RGB), "unknown_key"
    pairs = list(header().items()) + [("image", [4, 3])]
    double = bytes([0x80 | len(pairs)]) + b"".join(pack(k) + pack(v) for k, v in pairs)
    yield "duplicate_key", "the same key twice", double, "duplicate_key"
    for key in ("type", "version", "image", "tile", "halo", "samples", "format", "channels"):
        yield f"missing_{key}", "a key that must be there", pack(header(**{key: None})), "missing_key"
    yield "missing_total", "varying samples without their number", pack(header(samples="varying")), "missing_key"
    yield "missing_components", "a channel without them", pack(header(channels=[{"name": "c", "role": "color"}])), "missing_key"
    for name, changes in {
        "image_text": {"image": "4x3"}, "image_three": {"image": [4, 3, 1]}, "image_float": {"image": [4.0, 3.0]},
        "tile_negative": {"tile": [-1, 0, 2, 1]}, "halo_number": {"halo": 0}, "samples_float": {"samples": 2.0},
        "samples_negative": {"samples": -2}, "total_text": {"samples": "varying", "total": "3"},
        "format_number": {"format": 32}, "channels_map": {"channels": {}}, "channel_text": {"channels": ["color"]},
        "name_number": {"channels": [{**COLOR, "name": 1}]}, "components_text": {"channels": [{**COLOR, "components": "3"}]},
        "uniform_number": {"channels": [COLOR, {**LENS, "uniform": 1}]}, "tile_huge": {"tile": [0, 0, 2 ** 32, 1]},
    }.items():
        yield f"type_{name}", "a value of the wrong type", pack(header(**changes)), "wrong_type"
    yield "type_key", "a key that is a number", b"\x81\x01\x02", "wrong_type"
    for name, changes in {
        "samples": {"samples": "many"}, "format": {"format": "f64"}, "role": {"channels": [{**COLOR, "role": "colour"}]},
        "space": {"channels": [COLOR, {**DEPTH, "space": "world"}]},
        "film_f16": {"channels": [COLOR, {**FILM, "format": "f16"}]},
    }.items():
        yield f"value_{name}", "a word that means nothing here", pack(header(**changes)), "wrong_value"
    for name, changes in {
        "image_empty": {"image": [0, 3]}, "image_huge": {"image": [2 ** 20 + 1, 3]}, "tile_empty": {"tile": [0, 0, 0, 1]},
        "tile_outside": {"tile": [3, 0, 2, 1]}, "tile_overflow": {"tile": [2 ** 32 - 1, 0, 2, 1]},
        "halo_outside": {"halo": [1, 0, 0, 0]}, "halo_overflow": {"halo": [0, 0, 2 ** 32 - 1, 0]},
    }.items():
        yield f"geometry_{name}", "an impossible geometry", pack(header(**changes)), "bad_geometry"
    for name, channels in {
        "none": [], "no_color": [DEPTH], "two_colors": [COLOR, {**COLOR, "name": "other"}], "two_films": [COLOR, FILM, {**FILM, "name": "f"}],
        "same_name": [COLOR, {**DEPTH, "name": "color"}], "empty_name": [{**COLOR, "name": ""}], "long_name": [{**COLOR, "name": "c" * 256}],
        "color_of_4": [{**COLOR, "components": 4}], "feature_of_5": [COLOR, {**DEPTH, "components": 5}], "feature_of_0": [COLOR, {**DEPTH, "components": 0}],
        "too_many": [COLOR] + [{**DEPTH, "name": str(i), "components": 4} for i in range(64)],
    }.items():
        yield f"channels_{name}", "impossible channels", pack(header(channels=channels)), "bad_channels"
    varying = header(samples="varying", total=3)
    yield "counts_sum", "counts that do not add up", tile(varying, [[1, 2, 3]] * 3, [2, 2]), "bad_counts"
    yield "counts_total", "a total beyond what the pixels can have", pack({**varying, "total": 2 * 65535 + 1}), "bad_counts"
    yield "counts_size", "a count too few", pack(varying) + pack(b"\x03\x00"), "plane_size"
    yield "counts_constant", "counts as a constant", pack(varying) + pack(1), "wrong_type"
    for name, plane, code in (
        ("short", b"\0" * 12, "plane_size"), ("long", b"\0" * 20, "plane_size"), ("empty", b"", "plane_size"), ("nil", None, "wrong_type"),
        ("text", "0" * 16, "wrong_type"), ("array", [0, 0, 0, 0], "wrong_type"), ("map", header(), "wrong_type"),
        ("bool", True, "wrong_type"), ("ext", msgpack.ExtType(1, b"\0" * 16), "wrong_type"),
    ):
        yield f"plane_{name}", "a plane that is none", pack(header()) + pack_plane(RGB[0], "<f4") + pack(plane), code
    yield "plane_f32_for_f16", "f32 where f16 is announced", pack(header(format="f16")) + pack_plane(RGB[0], "<f4"), "plane_size"
    yield "plane_of_4_gib", "a marker that announces more than is true", pack(header()) + b"\xc6\xff\xff\xff\xff", "plane_size"
    yield "header_too_large", "a header of more than 64 KiB", pack({**header(), "x-big": b"\0" * 65536}), "header_too_large"
    yield "header_of_4_gi_pairs", "an endless header, announced", b"\xdf\xff\xff\xff\xff", "header_too_large"
    yield "header_deep", "arrays in arrays without end", b"\x81\xa3x-a" + b"\x91" * 70000, "header_too_large"
    yield "samples_per_pixel", "one sample too many in a pixel", pack(header(samples=65536)), "too_large"
    yield "samples_in_tile", "more samples than a tile may have", \
        pack(header(image=[65536, 65536], tile=[0, 0, 65536, 65536], samples=1)), "too_large"
    yield "plane_beyond_bin", "a plane that no bin can hold", \
        pack(header(image=[32768, 32768], tile=[0, 0, 32768, 32768], samples=1)), "too_large"
    yield "second_tile", "a good tile, then a bad one", whole + pack(header(tile=[4, 0, 1, 1])), "bad_geometry"


def results():
    report = {"preset": "lean", "seed": 1, "seconds": 0.5, "samples": 4, "spikes": 0, "exact": True,
              "halo": [0, 0, 0, 0], "halo_needed": [0, 0, 0, 0],
              "left_out": [{"plane": "color.1", "reason": "equal"}, {"plane": "lens.0", "reason": "constant"}],
              "left_out_bytes": 64, "work": {"done": 300, "planes": 60, "columns": 30, "distances": 10, "saved": 0.25}}
    result = {"type": "result", "version": 1, "image": [4, 3], "tile": [0, 0, 2, 1], "report": report}
    planes = [pack(np.asarray(p, "<f4").tobytes()) for p in ([1, 2], [3, 4], [5, 6])]
    problem = {"type": "urn:rpfd:problem:too_large", "title": "Too large", "status": 413, "detail": "it is", "code": "too_large", "limit": 5}
    error = {"type": "error", "version": 1, "tile": [2, 2, 2, 1], "problem": problem}
    end = pack({"type": "end", "version": 1, "tiles": 1, "errors": 1})
    whole = pack(result) + b"".join(planes) + pack(error)
    yield "result_stream", "a result, an error, the end", whole + end, None
    yield "result_error_without_tile", "an error that no tile is known for", \
        pack({**error, "tile": None}) + pack({"type": "end", "version": 1, "tiles": 0, "errors": 1}), None
    yield "result_unknown", "a message, its plane and a key of report that a reader does not know", \
        pack({"type": "progress", "version": 7, "done": [1, [2]]}) + pack(b"xyz") \
        + pack({**result, "report": {**report, "mood": {"good": [True]}}}) + b"".join(planes) + pack(error) + end, None
    yield "result_without_end", "a connection that was cut", whole, "truncated"
    yield "result_plane_size", "a plane of the wrong size", pack(result) + pack(b"\0" * 4), "plane_size"
    yield "result_constant", "planes of results are always spelt out", pack(result) + pack(1.5), "wrong_type"
    yield "result_geometry", "a core outside the image", pack({**result, "tile": [3, 0, 2, 1]}), "bad_geometry"
    yield "result_version", "another version", pack({**result, "version": 2}), "version"
    yield "result_trailing", "something after the end", whole + end + b"\xc0", "trailing"
    yield "result_incomplete", "an end without its numbers", pack({"type": "end", "version": 1}), "malformed"


def make():
    """Names of files -> bytes, and the manifest."""
    files, manifest = {}, []

    def add(kind, name, shows, data, **more):
        assert name not in files, name
        files[name] = data
        manifest.append({"file": f"{name}.msgpack", "kind": kind, "shows": shows, **more})

    for name, shows, tiles in good_tiles():
        add("tile", name, shows, b"".join(tile(*t) for t in tiles), tiles=[expected(*t) for t in tiles])
    for name, shows, data, code in bad_tiles():
        add("tile", "bad_" + name, shows, data, code=code)
    for name, shows, data, code in results():
        add("result", name if code is None else "bad_" + name, shows, data, **({} if code is None else {"code": code}))
    lines = ",\n".join("  " + json.dumps(entry) for entry in manifest)
    return files, manifest, '{"vectors": [\n' + lines + "\n]}\n"


def check(files, manifest, text):
    wrong = [name for name, data in files.items() if (HERE / f"{name}.msgpack").read_bytes() != data]
    if (HERE / "vectors.json").read_text() != text:
        wrong.append("vectors.json")
    assert not wrong, f"not what make.py makes: {wrong}"
    import jsonschema
    schema = json.loads((HERE.parent / "tile.schema.json").read_text())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    # What a schema of one map can see; the rest is about sizes, several keys at once, or bytes.
    seen = {"missing_key", "wrong_type", "wrong_value", "unknown_key", "version"}
    beyond = {"bad_type_key", "bad_counts_constant", "bad_type_image_float", "bad_type_samples_float"}
    good = bad = 0
    for entry in manifest:
        name, unpacker = entry["file"].removesuffix(".msgpack"), msgpack.Unpacker(strict_map_key=False)
        if entry.get("code", "ok") not in seen | {"ok"} or name in beyond or name.startswith("bad_plane_"):
            continue
        unpacker.feed(files[name])
        maps = [m for m in unpacker if isinstance(m, dict) and m.get("type") != "progress"]
        if "code" not in entry:
            for m in maps:
                validator.validate(m)
                good += 1
        elif name != "bad_result_constant":
            assert not all(validator.is_valid(m) for m in maps), f"{name}: the schema takes it"
            bad += 1
    print(f"{len(files)} messages as they should be; the schema takes {good} good maps and refuses {bad} bad ones")


def main():
    files, manifest, text = make()
    if sys.argv[1:] == ["--check"]:
        return check(files, manifest, text)
    for old in HERE.glob("*.msgpack"):
        old.unlink()
    for name, data in files.items():
        (HERE / f"{name}.msgpack").write_bytes(data)
    (HERE / "vectors.json").write_text(text)


if __name__ == "__main__":
    main()
