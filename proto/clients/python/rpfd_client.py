#!/usr/bin/env python3
"""A minimal client of tile.md and http.md: writes tiles, sends them, reads results. Needs NumPy and msgpack only.

  rpfd_client.py post URL IN.tiles OUT.npy     filter the tiles of a file (URL: http://host:port/v1/filter?preset=NAME)
  rpfd_client.py images URL IN.tiles OUT.exr   stitch them on the service (URL: http://host:port/v1/images?preset=NAME;
                                               with &halo=neighbors tiles need no halo)
  rpfd_client.py image RESULTS.msgpack OUT.npy stitch results that are in a file
  rpfd_client.py info IN.tiles                 print every header, and each plane's sum
  rpfd_client.py example OUT.tiles             write a small noisy image in four haloed tiles

A bearer token is taken from the environment variable RPFD_TOKEN. Progress and problems go to standard error. Files compressed with zstd are sent as they are ("images" looks into them
first, for which it needs zstandard).
"""
import json
import os
import sys
import time
import urllib.error
import urllib.parse
import urllib.request

import msgpack
import numpy as np

COLOR = {"name": "color", "role": "color", "components": 3}
FILM = {"name": "film", "role": "film", "components": 2}


def formats(header):
    """The NumPy types of a tile's planes, in order."""
    for channel in header["channels"]:
        half = channel["role"] != "film" and channel.get("format", header["format"]) == "f16"
        yield from ["<f2" if half else "<f4"] * channel["components"]


def pack_tile(header, planes, counts=None):
    """A tile as bytes. `planes`: one array a component, of the samples of the data window, pixels row by row and the
    samples of a pixel next to each other, in any shape with that order; or one number for a constant plane. `counts`:
    the samples of each pixel, if header["samples"] is "varying". NaN says that a sample has no such feature; in positions,
    N and N2 so do zeros."""
    parts = [msgpack.packb(header)]
    if counts is not None:
        parts.append(msgpack.packb(np.asarray(counts, "<u2").tobytes()))
    for plane, dtype in zip(planes, formats(header), strict=True):
        number = isinstance(plane, (int, float))
        parts.append(msgpack.packb(plane if number else np.asarray(plane, dtype).tobytes()))
    return b"".join(parts)


def read_tiles(file):
    """Yields (header, counts or None, planes): each plane a flat array of f32, or a number."""
    stream = msgpack.Unpacker(file, max_buffer_size=1 << 32)
    for header in stream:
        counts = np.frombuffer(next(stream), "<u2") if header["samples"] == "varying" else None
        planes = [next(stream) for _ in formats(header)]
        yield header, counts, [plane if isinstance(plane, (int, float)) else np.frombuffer(plane, dtype).astype("f4")
                               for plane, dtype in zip(planes, formats(header))]


def read_results(file):
    """Yields (message, planes): for a "result" its three planes, height x width; for others none. Messages of other
    types are skipped. Raises EOFError if the stream ends without its "end"."""
    stream = msgpack.Unpacker(file, max_buffer_size=1 << 32)
    for message in stream:
        kind = message.get("type") if isinstance(message, dict) else None
        if kind == "result":
            _, _, width, height = message["tile"]
            yield message, [np.frombuffer(next(stream), "<f4").reshape(height, width) for _ in range(3)]
        elif kind in ("error", "end"):
            yield message, []
            if kind == "end":
                return
    raise EOFError("the result stream was cut: it has no end")


def stitch(results):
    """The image (height x width x 3, NaN where nothing came) and the error messages of a result stream."""
    image, errors = None, []
    for message, planes in results:
        if message["type"] == "error":
            errors.append(message)
        elif message["type"] == "result":
            if image is None:
                width, height = message["image"]
                image = np.full((height, width, 3), np.nan, "f4")
            x, y, w, h = message["tile"]
            image[y:y + h, x:x + w] = np.stack(planes, -1)
    return image, errors


def call(method, url, body=None):
    """Sends a request (bytes, or an open file, which is streamed) and returns the answer to read from."""
    headers = {"Content-Type": "application/msgpack"}
    if hasattr(body, "peek") and body.peek(4)[:4] == b"\x28\xb5\x2f\xfd":
        headers["Content-Encoding"] = "zstd"
    if token := os.environ.get("RPFD_TOKEN"):
        headers["Authorization"] = f"Bearer {token}"
    try:
        return urllib.request.urlopen(urllib.request.Request(url, body, headers, method=method))
    except urllib.error.HTTPError as error:
        raise SystemExit(f"{error.code} {error.reason}: {error.read().decode(errors='replace')}") from None


def post(url, body):
    """Posts a tile stream (bytes, or an open file) and returns the answer to read results from."""
    return call("POST", url, body)


def progress(results):
    """Passes results on, and says how far they are."""
    done = total = 0
    for message, planes in results:
        if message["type"] == "result":
            done, total = done + message["tile"][2] * message["tile"][3], message["image"][0] * message["image"][1]
            print(f"{done} of {total} pixels", file=sys.stderr)
        yield message, planes


def announced(tiles):
    """What opens an image of tiles that lend each other their halos: channels and numbers of samples."""
    most, varying, channels = 1, set(), None
    for header, counts, _ in tiles:
        channels = channels or header["channels"]
        samples = header["samples"] if counts is None else int(counts.max(initial=0))
        most = max(most, samples)
        varying.add(samples if counts is None else "varying")
    return {"channels": channels, "samples" if varying == {most} else "max_samples": most}


def stitch_there(url, path, out):
    """Opens an image, sends it the tiles of a file, and fetches the EXR; the image is deleted. False if tiles failed."""
    url, _, query = url.partition("?")
    parameters = dict(urllib.parse.parse_qsl(query, strict_parsing=bool(query)))
    opener = open
    if path.endswith(".zst"):
        from zstandard import open as opener
    with opener(path, "rb") as file:
        width, height = next(read_tiles(file))[0]["image"]
    body = {"width": width, "height": height, **parameters}
    if parameters.get("halo") == "neighbors":
        with opener(path, "rb") as file:
            body.update(announced(read_tiles(file)))
    image = json.load(call("POST", url, json.dumps(body).encode()))
    image_url, end = f"{url}/{image['id']}", None
    try:
        with open(path, "rb") as file:
            for line in call("POST", image_url + "/tiles", file):
                end = json.loads(line)
                print(line.decode().rstrip(), file=sys.stderr)
        if end is None or end["state"] != "end":
            raise EOFError("the answer was cut: it has no end")
        if end["errors"] == 0:
            # Tiles that are stored are filtered later; where some are missing the service says so below.
            status = json.load(call("GET", image_url))
            while not status["complete"] and status.get("pixels_stored") == status["pixels"]:
                if status["trouble"]:
                    raise SystemExit(json.dumps(status["trouble"]))
                time.sleep(0.1)
                status = json.load(call("GET", image_url))
            with open(out, "wb") as file:
                file.write(call("GET", image_url + "/result.exr").read())
        return end["errors"] == 0
    finally:
        call("DELETE", image_url)


def example(side=16, halo=4, samples=4):
    """Tiles of a noisy gradient."""
    random = np.random.default_rng(1)
    lens = random.random((side, side, samples), dtype="f4")
    y, x = np.mgrid[:side, :side].astype("f4")[..., None] + np.zeros((1, 1, 1, samples), "f4")
    planes = [x + 0.5, y + 0.5, x / side + lens, y / side + lens, lens, lens]
    channels = [FILM, COLOR, {"name": "lens", "role": "random", "components": 2}]
    half = side // 2
    for cy in (0, half):
        for cx in (0, half):
            left, top = min(halo, cx), min(halo, cy)
            right, bottom = min(halo, side - half - cx), min(halo, side - half - cy)
            header = {"type": "tile", "version": 1, "image": [side, side], "tile": [cx, cy, half, half],
                      "halo": [left, top, right, bottom], "samples": samples, "format": "f32", "channels": channels}
            window = np.s_[cy - top:cy + half + bottom, cx - left:cx + half + right]
            yield pack_tile(header, [plane[window] for plane in planes] + [0.5])


def main(command=None, *args):
    if command == "post" and len(args) == 3:
        with open(args[1], "rb") as file:
            image, errors = stitch(progress(read_results(post(args[0], file))))
    elif command == "images" and len(args) == 3:
        return None if stitch_there(*args) else 1
    elif command == "image" and len(args) == 2:
        with open(args[0], "rb") as file:
            image, errors = stitch(read_results(file))
    elif command == "info" and len(args) == 1:
        with open(args[0], "rb") as file:
            for header, counts, planes in read_tiles(file):
                sums = [float(np.sum(plane, dtype="f8")) for plane in planes]
                print(json.dumps({**header, "sums": sums, "counts": None if counts is None else int(counts.sum())}))
        return None
    elif command == "example" and len(args) == 1:
        with open(args[0], "wb") as file:
            file.writelines(example())
        return None
    else:
        return __doc__
    for error in errors:
        print(json.dumps(error), file=sys.stderr)
    if image is None:
        return "no results"
    np.save(args[-1], image)
    return 1 if errors else None


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
