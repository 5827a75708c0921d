// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <string>

#include "engine/taps.h"
#include "fuzz/budget.h"
#include "observe/recording.h"
#include "zmtp/curve.h"

namespace vla::fuzz {

/// The files that commands read besides bundles and images.
enum class FileKind { recording, taps, keys };

/// Reads bytes as such a file, from the folder, to its end. Aborts when it is refused with another class of error than
/// a file can cause, or is read without end.
inline bool check_file(FileKind kind, std::string_view bytes, const std::string& folder) {
  const Budget budget(10, 512);
  std::filesystem::create_directories(folder);
  const std::string file = folder + "/" + (kind == FileKind::recording ? observe::kRecordingFile : "file");
  std::ofstream(file, std::ios::binary | std::ios::trunc)
      .write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  const auto refuse = [](const Error& error) {
    const bool expected =
        error.code == Code::bad_request || error.code == Code::bad_bundle || error.code == Code::usage;
    if (!expected || error.message().size() > 1 << 16) std::abort();
    return false;
  };
  if (kind == FileKind::keys) {
    const auto keys = zmtp::read_public_keys(file);
    return keys ? true : refuse(keys.error());
  }
  if (kind == FileKind::taps) {
    const auto taps = read_taps(file);
    return taps ? true : refuse(taps.error());
  }
  auto recording = observe::Recording::open(folder);
  if (!recording) return refuse(recording.error());
  for (std::size_t n = 0; n <= bytes.size(); ++n) {
    const auto piece = recording->next();
    if (!piece) return refuse(piece.error());
    if (!*piece) return true;
  }
  std::abort();
}

}  // namespace vla::fuzz
