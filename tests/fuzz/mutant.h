// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstring>
#include <deque>

#include "bundle/gguf_writer.h"
#include "fuzz/bundle_target.h"
#include "fuzz/mutate.h"

namespace vla::fuzz {

inline void change_key(Keys& keys, Random& random) {
  auto values = keys.all();
  if (values.empty()) return;
  auto key = values.begin();
  std::advance(key, static_cast<std::ptrdiff_t>(below(random, values.size())));
  const auto* text = std::get_if<std::string>(&key->second);
  if (random() % 8 == 0) {
    values.erase(key);
  } else if (text != nullptr && text->find('{') != std::string::npos) {
    key->second = odd_json(*text, random);
  } else {
    key->second = odd_value(key->second, random);
  }
  keys = Keys(std::move(values));
}

/// `data` is the changed tensor's, and has to outlive the tensors.
inline void change_tensor(std::vector<TensorInfo>& tensors, std::string& data, Random& random) {
  if (tensors.empty()) return;
  const std::size_t which = below(random, tensors.size());
  TensorInfo& tensor = tensors[which];
  data.assign(reinterpret_cast<const char*>(tensor.data.data()), tensor.data.size());
  const auto number = static_cast<float>(odd_number(random));
  switch (random() % 4) {
    case 0:
      if (!tensor.shape.empty()) std::swap(tensor.shape.front(), tensor.shape.back());
      break;
    case 1:
      for (std::size_t i = 0; i + sizeof number <= data.size(); i += sizeof number)
        std::memcpy(data.data() + i, &number, sizeof number);
      break;
    case 2:
      for (char& byte : data) byte = static_cast<char>(random());
      break;
    default:
      tensors.erase(tensors.begin() + static_cast<std::ptrdiff_t>(which));
      return;
  }
  tensor.data = std::as_bytes(std::span(data));
}

/// A bundle with one or two keys or tensors made odd, and now and then a few bytes of the file.
inline std::string mutant(const std::string& bytes, Random& random) {
  const std::string fitted = sealed(bytes);
  const auto bundle = Bundle::parse(std::as_bytes(std::span(fitted)), "mutant");
  if (!bundle) return damaged(bytes, random);
  Keys keys = bundle->keys();
  std::vector<TensorInfo> tensors(bundle->tensors().begin(), bundle->tensors().end());
  std::deque<std::string> data;
  for (std::size_t n = 1 + below(random, 2); n > 0; --n) {
    if (random() % 4 != 0) {
      change_key(keys, random);
    } else {
      change_tensor(tensors, data.emplace_back(), random);
    }
  }
  const std::string changed = write_gguf(keys, tensors);
  return random() % 8 == 0 ? damaged(changed, random) : changed;
}

}  // namespace vla::fuzz
