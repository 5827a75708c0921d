// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "base/npy.h"

#include <doctest/doctest.h>

#include "support/editable_bundle.h"

namespace npy_test {

using namespace vla;

namespace {

Result<NpyArray> parse(const std::string& bytes) { return parse_npy(std::as_bytes(std::span(bytes)), "test.npy"); }

std::string npy(const std::string& header, const std::string& data) {
  const char length[2] = {static_cast<char>(header.size()), 0};
  return std::string("\x93NUMPY\x01\x00", 8) + std::string(length, 2) + header + data;
}

}  // namespace

TEST_CASE("what is written is read back") {
  const std::vector<float> values = {1, 2, 3, 4, 5, 6};
  const std::string path = test::scratch_path("written.npy");
  REQUIRE(write_npy(path, values, 2, 3).ok());
  const std::string bytes = test::read_text(path);
  CHECK(bytes.size() % 64 == 24);  // 24 bytes of data behind an aligned header
  const auto array = parse(bytes);
  REQUIRE(array.ok());
  CHECK(array->shape == std::vector<std::size_t>{2, 3});
  CHECK(std::get<std::vector<float>>(array->values) == values);
}

TEST_CASE("arrays of other types, orders and damaged headers are refused") {
  const std::string good = npy("{'descr': '|u1', 'fortran_order': False, 'shape': (2, 2), }", "abcd");
  REQUIRE(parse(good).ok());
  for (std::size_t size = 0; size < good.size(); ++size) CHECK_FALSE(parse(good.substr(0, size)).ok());
  for (const char* header :
       {"{'descr': '<f8', 'fortran_order': False, 'shape': (4,), }",
        "{'descr': '|u1', 'fortran_order': True, 'shape': (4,), }",
        "{'descr': '|u1', 'fortran_order': False, 'shape': (5,), }",
        "{'descr': '|u1', 'fortran_order': False, 'shape': 4}",
        "{'descr': '|u1', 'fortran_order': False, 'shape': (99999999999, 99999999999, 99999999999)}", "{}", ""})
    CHECK_FALSE(parse(npy(header, "abcd")).ok());
}

}  // namespace npy_test
