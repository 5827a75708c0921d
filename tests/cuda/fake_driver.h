// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <map>
#include <set>
#include <string>
#include <vector>

#include "cuda/driver/driver.h"

/// NVIDIA's driver without a device. Nothing runs before somebody waits: operations become nodes that know which ones
/// they come after, and run in any order that this allows: those that are waited for, and now and then all others, so
/// that a stream that is not waited for shows. A captured
/// graph is such nodes, run again at each launch. Kernels run on the emulated machine; a module is PTX, or kHostModule.
namespace vla::test::cuda {

/// A module of the kernels that the host's compiler made.
constexpr const char* kHostModule = "host";

constexpr int kInvalidValue = 1, kOutOfMemory = 2, kInvalidImage = 200, kInvalidContext = 201, kInvalidPtx = 218,
              kInvalidHandle = 400, kNotFound = 500, kLaunchFailed = 719, kCaptureUnsupported = 900,
              kCaptureUnjoined = 904, kInvalidCluster = 912;

/// How the driver behaves, and what was asked of it.
struct FakeDriver {
  int version = 13000, n_device = 1, major = 9, minor = 0, n_sm = 16;
  std::size_t memory = std::size_t{1} << 30;
  /// The number of the call that fails, counted from 1 since reset, and with what; 0: none. A lost device answers every
  /// later call so too.
  long fail_at = 0;
  int failure = kLaunchFailed;
  bool is_lost_then = false;
  /// Else kernels leave what was there, and memory is zeros at first: for tests of calls alone.
  bool computes = true;
  /// Whether it takes machine code, which it reads as kHostModule.
  bool takes_machine_code = false;
  std::FILE* counts = nullptr;  // gets a line for each call

  std::map<std::string, long> n_call;  // by symbol
  long n_calls = 0;
  bool logs = false;
  std::vector<std::string> log;                 // of symbols, where it logs
  std::string failed_call;                      // the first that was told to fail
  std::vector<std::string> refused;             // symbols of calls that were answered with an error that nobody told it
  std::vector<std::string> images;              // what it was asked to load, its first 32 bytes
  std::string fault;                            // why a kernel failed
  std::set<std::string> launched, in_clusters;  // kernels; in_clusters: in clusters of several blocks
  std::size_t used = 0;
  long n_handle = 0;  // contexts, streams, events, modules, graphs and host memory that were not given back
};
FakeDriver& fake_driver();
/// As it was at first, with nothing held.
void reset_fake_driver();
vla::cuda::Driver fake_driver_table();
/// What makes tensor maps alone: it needs no device, and is not counted.
vla::cuda::Driver tensor_map_driver();

}  // namespace vla::test::cuda
