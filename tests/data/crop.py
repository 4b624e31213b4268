#!/usr/bin/env python3
"""Cuts a rectangle out of a render: its samples as bare tiles of an image of their own, and its reference.

  crop.py IN.tiles[.zst] REFERENCE.exr X Y W H OUT_TILES.zst OUT_REFERENCE.exr [--tile N]

The rectangle becomes the image: pixels are renumbered from (0, 0), and film positions move along, exactly (subtracting a
whole number makes an f32 smaller, which never rounds). Every other value stays as it is, bit for bit.

Needs: numpy, msgpack, zstandard, OpenEXR.
"""
import argparse

import msgpack
import numpy as np
import OpenEXR
import zstandard


def read(path):
    """Channels and planes [H, W, samples] of a whole image, from tiles with or without halos."""
    file = open(path, "rb")
    stream = zstandard.ZstdDecompressor().stream_reader(file) if path.endswith(".zst") else file
    messages = msgpack.Unpacker(stream, max_buffer_size=1 << 31)
    planes = channels = None
    for header in messages:
        if header["samples"] == "varying" or header["format"] != "f32" or any("format" in c for c in header["channels"]):
            raise SystemExit("only f32 tiles with as many samples in every pixel can be cut")
        (width, height), (x, y, w, h) = header["image"], header["tile"]
        left, top, right, bottom = header["halo"]
        samples, channels = header["samples"], header["channels"]
        if planes is None:
            planes = [np.zeros((height, width, samples), "<f4") for c in channels for _ in range(c["components"])]
        for plane in planes:
            part = next(messages)
            if isinstance(part, bytes):
                part = np.frombuffer(part, "<f4").reshape(top + h + bottom, left + w + right, samples)
                part = part[top:top + h, left:left + w]
            plane[y:y + h, x:x + w] = part
    return channels, planes


def write(path, channels, planes, size):
    height, width, samples = planes[0].shape
    packer = msgpack.Packer(use_bin_type=True, use_single_float=True)
    stream = b""
    for y in range(0, height, size):
        for x in range(0, width, size):
            w, h = min(size, width - x), min(size, height - y)
            stream += packer.pack({"type": "tile", "version": 1, "image": [width, height], "tile": [x, y, w, h],
                                   "halo": [0, 0, 0, 0], "samples": samples, "format": "f32", "channels": channels})
            for plane in planes:
                part = np.ascontiguousarray(plane[y:y + h, x:x + w])
                bits = part.view("<u4")
                constant = np.all(bits == bits.flat[0])
                stream += packer.pack(float(part.flat[0]) if constant else part.tobytes())
    with open(path, "wb") as file:
        file.write(zstandard.ZstdCompressor(level=19).compress(stream))


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tiles")
    parser.add_argument("reference")
    for name in "xywh":
        parser.add_argument(name, type=int)
    parser.add_argument("out_tiles")
    parser.add_argument("out_reference")
    parser.add_argument("--tile", type=int, default=64)
    args = parser.parse_args()

    window = np.s_[args.y:args.y + args.h, args.x:args.x + args.w]
    channels, planes = read(args.tiles)
    planes = [plane[window] for plane in planes]
    assert planes[0].shape[:2] == (args.h, args.w), "the rectangle must lie inside the image"
    first = 0
    for channel in channels:
        if channel["role"] == "film":
            planes[first] = planes[first] - np.float32(args.x)
            planes[first + 1] = planes[first + 1] - np.float32(args.y)
        first += channel["components"]
    write(args.out_tiles, channels, planes, args.tile)

    pixels = OpenEXR.File(args.reference).channels()
    pixels = pixels["RGB"].pixels if "RGB" in pixels else np.stack([pixels[c].pixels for c in "RGB"], -1)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(pixels[window], "f4")}).write(args.out_reference)


if __name__ == "__main__":
    main()
