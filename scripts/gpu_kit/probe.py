# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""NVIDIA's driver by itself, call by call as src/cuda/driver makes them, with what its compiler says: for when nothing else runs.

    python3 probe.py [FILE ...]     # files of PTX or machine code"""

import argparse
import ctypes
import sys
import time
from ctypes import byref, c_char_p, c_int, c_size_t, c_ubyte, c_uint, c_uint64, c_void_p

ERROR_LOG, ERROR_LOG_SIZE = 5, 6  # options of cuModuleLoadDataEx


def load():
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        sys.exit(f"libcuda.so.1: {error}")


class Probe:
    def __init__(self):
        self.driver = load()

    def __call__(self, symbol, *arguments):
        """Makes a call and tells what it answered."""
        start = time.perf_counter()
        code = getattr(self.driver, symbol)(*arguments)
        name = c_char_p()
        self.driver.cuGetErrorName(code, byref(name))
        said = "ok" if code == 0 else f"{code} {(name.value or b'?').decode()}"
        print(f"{symbol}: {said} ({1e3 * (time.perf_counter() - start):.1f} ms)", flush=True)
        return code

    def open(self):
        version, device, context = c_int(), c_int(), c_void_p()
        self("cuInit", 0)
        self("cuDriverGetVersion", byref(version))
        print(f"  CUDA {version.value}")
        self("cuDeviceGet", byref(device), 0)
        self("cuDevicePrimaryCtxRetain", byref(context), device)
        self("cuCtxSetCurrent", context)

    def load(self, file):
        log = ctypes.create_string_buffer(1 << 16)
        options = (c_int * 2)(ERROR_LOG, ERROR_LOG_SIZE)
        values = (c_void_p * 2)(ctypes.cast(log, c_void_p), c_void_p(len(log)))
        module = c_void_p()
        with open(file, "rb") as image:
            code = self("cuModuleLoadDataEx", byref(module), image.read() + b"\0", 2, options, values)
        print(f"  {file}{': ' + log.value.decode(errors='replace') if code else ''}")

    def capture(self):
        """A graph of a fill and of an event that notes the time."""
        stream, event, graph, executable, memory = c_void_p(), c_void_p(), c_void_p(), c_void_p(), c_uint64()
        self("cuStreamCreate", byref(stream), 1)
        self("cuEventCreate", byref(event), 0)
        self("cuMemAlloc_v2", byref(memory), c_size_t(1 << 20))
        self("cuStreamBeginCapture_v2", stream, 1)
        self("cuMemsetD8Async", memory, c_ubyte(1), c_size_t(1 << 20), stream)
        self("cuEventRecordWithFlags", event, stream, c_uint(1))
        self("cuStreamEndCapture", stream, byref(graph))
        self("cuGraphInstantiateWithFlags", byref(executable), graph, c_uint64(0))
        self("cuGraphLaunch", executable, stream)
        self("cuStreamSynchronize", stream)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*")
    files = parser.parse_args().files
    probe = Probe()
    probe.open()
    for file in files:
        probe.load(file)
    probe.capture()
