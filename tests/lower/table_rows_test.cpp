// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cpu/table_rows.h"

#include <doctest/doctest.h>

#include <cstdio>
#include <cstring>

#include "support/editable_bundle.h"

namespace table_rows_test {

using namespace vla;
using lower::TableRows;
using test::EditableBundle;

namespace {

constexpr std::int64_t kWidth = 700, kRows = 3000;  // rows of 1400 bytes, which cross blocks

EditableBundle bundle_with_table() {
  EditableBundle bundle;
  for (const char* key : {"vla.arch", "vla.source.name", "vla.source.revision", "vla.source.converter"})
    bundle.set(key, Value(std::string("test")));
  bundle.set("vla.dtype", Value(std::string("bf16")));
  bundle.set("vla.bundle_version", Value(std::int64_t{1}));
  std::string bytes;
  for (std::int64_t i = 0; i < kRows; ++i) {
    std::string row(2 * kWidth, static_cast<char>(i));
    std::memcpy(row.data(), &i, sizeof(i));
    bytes += row;
  }
  bundle.tensors.push_back({"table", DType::bf16, {kWidth, kRows}, bytes});
  return bundle;
}

/// The row's own number, at its beginning; -1 where what follows is of another row.
std::int64_t number_in(TableRows& rows, std::int64_t i) {
  std::vector<std::byte> row(rows.row_size());
  rows.copy(i, row.data());
  std::int64_t found;
  std::memcpy(&found, row.data(), sizeof(found));
  return row.back() == static_cast<std::byte>(found) ? found : -1;
}

struct OpenedTable {
  explicit OpenedTable(const std::string& path) : bundle(*Bundle::open(path)), list(bundle.keys(), &bundle) {
    auto made = TableRows::make(bundle, list.declare("table", Storage::table, {kWidth, kRows}));
    REQUIRE(made.ok());
    rows = std::move(*made);
  }
  Bundle bundle;
  ParamList list;
  std::unique_ptr<TableRows> rows;
};

}  // namespace

TEST_CASE("rows of a table are those of the file, however many are looked up, and few of them stay in memory") {
  OpenedTable table(bundle_with_table().write("table.gguf"));
  for (int round = 0; round < 2; ++round)
    for (std::int64_t i = 0; i < kRows; ++i) REQUIRE(number_in(*table.rows, i * 7 % kRows) == i * 7 % kRows);
  CHECK(table.rows->status().ok());
  CHECK(table.rows->size() < 2 * kWidth * kRows / 2);
}

TEST_CASE("a row that the file has no more is refused by name; rows that are kept go on") {
  const std::string path = bundle_with_table().write("table.gguf");
  OpenedTable table(path);
  CHECK(number_in(*table.rows, 2500) == 2500);
  std::FILE* file = std::fopen(path.c_str(), "r+b");  // in place, as cp does
  REQUIRE(file != nullptr);
  const long place = -100 * 2 * kWidth;  // in row 2900
  std::fseek(file, place, SEEK_END);
  std::fputc(0x55, file);
  std::fclose(file);
  CHECK(number_in(*table.rows, 2500) == 2500);
  CHECK(number_in(*table.rows, 0) == 0);
  CHECK(table.rows->status().ok());
  CHECK(number_in(*table.rows, 2900) == 0);  // zeros
  const Status changed = table.rows->status();
  REQUIRE(!changed.ok());
  CHECK(changed.error().code == Code::bad_bundle);
  CHECK(changed.error().message().find("renaming a new file over it") != std::string::npos);
  CHECK(number_in(*table.rows, 2500) == 2500);
  CHECK(table.rows->status().ok());
}

}  // namespace table_rows_test
