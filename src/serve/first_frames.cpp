// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "serve/first_frames.h"

#include <filesystem>

#include "base/file.h"
#include "processor/picture.h"

namespace vla::serve {

Result<std::vector<std::string>> save_first_frames(const Observation& observation, const Robot& robot,
                                                   const std::string& folder) {
  std::error_code failed;
  std::filesystem::create_directories(folder, failed);
  if (failed) return Error{Code::io, folder, "a folder that can be made", failed.message()};
  std::vector<std::string> files;
  const FeatureNames& views = robot.processor().views();
  for (const auto& [name, frame] : observation.views) {
    if (!frame) continue;
    VLA_TRY(const int view, views.find(name));
    VLA_TRY(const Frame picture, picture_of(robot.processor(), *frame, view));
    VLA_TRY(const std::vector<std::byte> png, encode_png(picture));
    const std::string& full = views.names()[static_cast<std::size_t>(view)];
    files.push_back((std::filesystem::path(folder) / (full.substr(full.rfind('.') + 1) + ".png")).string());
    VLA_CHECK(write_file(files.back(), png));
  }
  return files;
}

}  // namespace vla::serve
