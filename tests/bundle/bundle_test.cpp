// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/bundle.h"

#include <doctest/doctest.h>

#include <cstring>
#include <ctime>
#include <fstream>
#include <limits>
#include <random>

#include "bundle/params.h"
#include "support/editable_bundle.h"

namespace bundle_test {

using namespace vla;
using test::EditableBundle;

namespace {

EditableBundle small_bundle() {
  EditableBundle bundle;
  bundle.set("vla.bundle_version", Value(std::int64_t{1}));
  for (const auto& [key, value] : {std::pair("vla.arch", "smolvla"),
                                   {"vla.dtype", "f32"},
                                   {"vla.source.name", "x"},
                                   {"vla.source.revision", ""},
                                   {"vla.source.converter", "test"}})
    bundle.set(key, Value(std::string(value)));
  bundle.set("lm.d_model", Value(std::int64_t{4}));
  bundle.set("lm.names", Value(std::vector<std::string>{"a", "b"}));
  bundle.tensors.push_back({"lm.weight", DType::f32, {4, 2}, std::string(32, '\1')});
  bundle.tensors.push_back({"stats.x", DType::f32, {3}, std::string(12, '\0')});
  return bundle;
}

Result<Bundle> parse(const std::string& bytes) { return Bundle::parse(std::as_bytes(std::span(bytes)), "test.gguf"); }

std::string refusal(const std::string& bytes) {
  const auto bundle = parse(bytes);
  REQUIRE_FALSE(bundle.ok());
  CHECK(bundle.error().code == Code::bad_bundle);
  return bundle.error().message();
}

bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

}  // namespace

TEST_CASE("a sound bundle gives back its keys and tensors") {
  const std::string bytes = small_bundle().bytes();
  const auto bundle = parse(bytes);
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  CHECK(*bundle->keys().integer("lm.d_model", kAnySize) == 4);
  CHECK(bundle->keys().strings("lm.names")->at(1) == "b");
  REQUIRE(bundle->find("lm.weight") != nullptr);
  CHECK(bundle->find("lm.weight")->shape == std::vector<std::int64_t>{4, 2});
  CHECK(bundle->stats("stats.x")->size() == 3);
}

TEST_CASE("a bundle that is cut anywhere is refused") {
  const std::string bytes = small_bundle().bytes();
  for (std::size_t size = 0; size < bytes.size(); ++size) refusal(bytes.substr(0, size));
}

TEST_CASE("a bundle in which any one bit is flipped is refused") {
  const std::string bytes = small_bundle().bytes();
  for (std::size_t i = 0; i < bytes.size(); ++i)
    for (int bit = 0; bit < 8; ++bit) {
      std::string damaged = bytes;
      damaged[i] = static_cast<char>(damaged[i] ^ (1 << bit));
      CHECK_FALSE(parse(damaged).ok());
    }
}

TEST_CASE("bytes after the last tensor are refused") {
  CHECK(contains(refusal(small_bundle().bytes() + std::string(64, 'x')), "end: expected"));
}

TEST_CASE("a flipped weight is reported as a checksum that does not fit") {
  std::string bytes = small_bundle().bytes();
  bytes[bytes.find(std::string(32, '\1'))] = 2;
  CHECK(contains(refusal(bytes), "damaged or edited"));
}

TEST_CASE("another version of the bundle is refused with the next move") {
  EditableBundle bundle = small_bundle();
  bundle.set("vla.bundle_version", Value(std::int64_t{0}));
  CHECK(contains(refusal(bundle.bytes()), "run vla-convert again"));
  bundle.set("vla.bundle_version", Value(std::int64_t{2}));
  CHECK(contains(refusal(bundle.bytes()), "needs a newer vla"));
}

TEST_CASE("a GGUF file that is no vla bundle says so") {
  EditableBundle bundle = small_bundle();
  bundle.remove_key("vla.bundle_version");
  CHECK(contains(refusal(bundle.bytes()), "a GGUF file of another kind"));
}

TEST_CASE("a file of another kind is refused by its first bytes") {
  CHECK(contains(refusal(std::string(4096, 'P')), "a GGUF file"));
}

TEST_CASE("a list that claims more elements than the file has bytes is refused before memory is taken") {
  std::string bytes = small_bundle().bytes();
  const std::size_t count = bytes.find("lm.names") + 8 + 4 + 4;
  const std::uint64_t huge = std::numeric_limits<std::uint64_t>::max() / 8;
  std::memcpy(bytes.data() + count, &huge, 8);
  CHECK(contains(refusal(bytes), "lm.names"));
}

TEST_CASE("random bytes behind a GGUF header never crash the reader") {
  std::mt19937 random(7);
  for (int round = 0; round < 20000; ++round) {
    std::string bytes = "GGUF";
    bytes += std::string("\3\0\0\0", 4);
    for (int i = 0; i < 16; ++i) bytes += static_cast<char>(i % 8 == 0 ? random() % 4 : 0);
    const std::size_t size = random() % 200;
    for (std::size_t i = 0; i < size; ++i) bytes += static_cast<char>(random() % 3 == 0 ? random() : 0);
    CHECK_FALSE(parse(bytes).ok());
  }
}

TEST_CASE("statistics that are not finite are refused") {
  EditableBundle bundle = small_bundle();
  const float nan = std::numeric_limits<float>::quiet_NaN();
  std::memcpy(bundle.tensor("stats.x").data.data(), &nan, 4);
  const std::string bytes = bundle.bytes();
  const auto stats = parse(bytes)->stats("stats.x");
  REQUIRE_FALSE(stats.ok());
  CHECK(contains(stats.error().message(), "finite"));
}

TEST_CASE("a key of another type names both types") {
  const std::string bytes = small_bundle().bytes();
  const auto value = parse(bytes)->keys().string("lm.d_model");
  REQUIRE_FALSE(value.ok());
  CHECK(value.error().message() == "lm.d_model: expected a string, found an integer");
}

TEST_CASE("a missing file is an io error with its path") {
  const auto bundle = Bundle::open("/nowhere/policy.gguf");
  REQUIRE_FALSE(bundle.ok());
  CHECK(bundle.error().code == Code::io);
  CHECK(contains(bundle.error().message(), "/nowhere/policy.gguf"));
}

TEST_CASE("an empty file is a bad bundle") {
  const auto bundle = Bundle::open(test::write_file("empty.gguf", ""));
  REQUIRE_FALSE(bundle.ok());
  CHECK(bundle.error().code == Code::bad_bundle);
}

TEST_CASE("bind reports every missing, misshapen and unused tensor and every missing key in one error") {
  const std::string bytes = small_bundle().bytes();
  const auto bundle = parse(bytes);
  ParamList list(bundle->keys(), &*bundle);
  const Scope root(list, "");
  const Scope lm = root / "lm";
  lm.matrix("weight", 4, 3);
  lm.vector("bias", 3);
  lm.dim("n_layer");
  const Status status = list.report("smolvla", [](const std::string&) { return false; });
  REQUIRE_FALSE(status.ok());
  const std::string text = status.error().message();
  CHECK(contains(text, "4 problems"));
  CHECK(contains(text, "wrong shape     lm.weight"));
  CHECK(contains(text, "missing tensor  lm.bias"));
  CHECK(contains(text, "missing key     lm.n_layer"));
  CHECK(contains(text, "unused tensor   stats.x"));
}

TEST_CASE("a ternary matrix is bytes of four codes, none of which is 3") {
  const auto report = [](DType type, const std::vector<std::int64_t>& shape, const std::string& data) {
    EditableBundle bundle = small_bundle();
    bundle.tensors.push_back({"a.weight", type, shape, data});
    bundle.tensors.push_back({"a.scale", DType::f32, {1}, std::string(4, '\1')});
    const std::string bytes = bundle.bytes();
    const auto parsed = parse(bytes);
    REQUIRE_MESSAGE(parsed.ok(), (parsed ? "" : parsed.error().message()));
    ParamList list(parsed->keys(), &*parsed);
    const Param* weight = (Scope(list, "") / "a").ternary("weight", 12, 2);
    CHECK(weight->encoding == Encoding{DType::ternary, 24});
    CHECK(weight->shape == std::vector<std::int64_t>{12, 2});
    REQUIRE(weight->scales != nullptr);
    CHECK(weight->scales->source == parsed->find("a.scale"));
    const Status status = list.report("bitvla", [](const std::string& name) { return name[0] != 'a'; });
    return status.ok() ? "" : status.error().message();
  };
  CHECK(report(DType::i8, {3, 2}, std::string("\x00", 1) + "\x55\xAA\x24\x18\x62").empty());
  for (const char* wrong : {"\x03", "\x0C", "\x30", "\xC0", "\xFF"})
    CHECK(contains(report(DType::i8, {3, 2}, "\x55\x55\xAA\x24\x18" + std::string(wrong)), "wrong code      a.weight"));
  CHECK(contains(report(DType::i8, {12, 2}, std::string(24, '\x55')), "wrong shape     a.weight"));
  CHECK(contains(report(DType::f32, {3, 2}, std::string(24, '\x55')), "wrong dtype     a.weight"));
  CHECK(contains(report(DType::f32, {3, 2}, std::string(24, '\x55')), "expected i8, file has f32"));
}

TEST_CASE("sizes count bits, and elements of less than a byte fill whole ones") {
  CHECK(dtype_size(DType::ternary, 5) == 2);
  CHECK(dtype_size(DType::bf16, 3) == 6);
  CHECK(dtype_size(DType::f64, 1) == 8);
  CHECK(Encoding{DType::i8, 64}.n_scale(640) == 10);
  CHECK(Encoding{DType::bf16}.n_scale(640) == 0);
}

TEST_CASE("bytes are no matrix, table or vector of floats") {
  EditableBundle bundle = small_bundle();
  for (const char* name : {"a", "b", "c"}) bundle.tensors.push_back({name, DType::i8, {4}, "abcd"});
  const std::string bytes = bundle.bytes();
  const auto parsed = parse(bytes);
  REQUIRE(parsed.ok());
  ParamList list(parsed->keys(), &*parsed);
  list.declare("a", Storage::matrix, {4}), list.declare("b", Storage::table, {4}),
      list.declare("c", Storage::vector, {4});
  const Status status = list.report("smolvla", [](const std::string& name) { return name.size() > 1; });
  REQUIRE_FALSE(status.ok());
  CHECK(contains(status.error().message(), "3 problems"));
}

TEST_CASE("a size out of range is a problem and never a loop without end") {
  Keys keys;
  keys.set("lm.n_layer", Value(std::int64_t{2000000000}));
  ParamList list(keys, nullptr);
  CHECK((Scope(list, "") / "lm").n_layer("n_layer") == 1);
  CHECK_FALSE(list.report("smolvla", {}).ok());
}

TEST_CASE("a number out of its range names the range, and one of another type both types") {
  Keys keys;
  keys.set("lm.norm_eps", 1e30);
  keys.set("lm.n_layer", std::int64_t{1} << 40);
  keys.set("lm.sections", std::vector<std::int64_t>{1, -1});
  CHECK(keys.number("lm.norm_eps", kNormEps).error().message() == "lm.norm_eps: expected 1e-13 to 0.01, found 1e+30");
  CHECK(keys.integer("lm.n_layer", {1, 512}).error().message() == "lm.n_layer: expected 1 to 512, found 1099511627776");
  CHECK(contains(keys.integers("lm.sections", kAnySize).error().message(), "expected 0 to 2147483647, found -1"));
  keys.set("lm.norm_eps", std::numeric_limits<double>::quiet_NaN());
  CHECK(contains(keys.number("lm.norm_eps", kNormEps).error().message(), "found nan"));
}

TEST_CASE("a report of very many problems names the first fifty and counts the others, in no quadratic time") {
  EditableBundle bundle = small_bundle();
  for (int i = 0; i < 100000; ++i) bundle.tensors.push_back({"unknown." + std::to_string(i), DType::f32, {1}, "abcd"});
  const std::string bytes = bundle.bytes();
  const auto parsed = parse(bytes);
  REQUIRE_MESSAGE(parsed.ok(), (parsed ? "" : parsed.error().message()));
  const std::clock_t start = std::clock();
  ParamList list(parsed->keys(), &*parsed);
  for (int i = 0; i < 50000; ++i) list.declare("unknown." + std::to_string(2 * i), Storage::vector, {1});
  CHECK(std::clock() - start < 2 * CLOCKS_PER_SEC);
  const std::string message = list.report("smolvla", [](const std::string&) { return false; }).error().message();
  CHECK(contains(message, "50002 problems"));
  CHECK(contains(message, "and 49952 more"));
  CHECK(message.size() < 10000);
}

/// A tensor's bytes, or the refusal.
std::string read_text(const Bundle& bundle, const char* name) {
  ReadBuffer buffer;
  const auto data = bundle.read(bundle.find(name)->data, buffer);
  return data ? std::string(reinterpret_cast<const char*>(data->data()), data->size()) : data.error().message();
}

TEST_CASE("a file that is written over or cut after it was opened is refused where that shows, and read where not") {
  EditableBundle editable = small_bundle();
  std::string large(4 << 20, '\2');
  editable.tensors.push_back({"lm.large", DType::f32, {1 << 20}, large});
  const std::string bytes = editable.bytes();
  for (const bool cut : {false, true}) {
    const std::string path = test::write_file("changed.gguf", bytes);
    const auto bundle = Bundle::open(path);
    REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
    CHECK(read_text(*bundle, "lm.large") == large);
    std::string now = bytes;  // in place, as cp does
    now.resize(cut ? now.size() - 5000 : now.size());
    now[now.size() - 4096] ^= 1;
    test::write_file("changed.gguf", now);
    CHECK(read_text(*bundle, "lm.weight") == std::string(32, '\1'));
    CHECK(bundle->stats("stats.x")->size() == 3);
    CHECK(contains(read_text(*bundle, "lm.large"), "renaming a new file over it"));
    ReadBuffer buffer;
    const auto beginning = bundle->find("lm.large")->data.first(1 << 20);
    CHECK(bundle->read(beginning, buffer).ok());
    std::remove(path.c_str());
    CHECK(bundle->stats("stats.x")->size() == 3);
  }
}

TEST_CASE("a bundle that is opened takes the memory of its keys, not of its tensors") {
  EditableBundle editable = small_bundle();
  editable.tensors.push_back({"lm.large", DType::f32, {16 << 20}, std::string(64 << 20, '\2')});
  const std::string path = editable.write("large.gguf");
  editable.tensors.clear();
  const auto resident = [] {  // pages that are in memory
    std::ifstream statm("/proc/self/statm");
    std::size_t size = 0, pages = 0;
    statm >> size >> pages;
    return pages;
  };
  const std::size_t before = resident();
  const auto bundle = Bundle::open(path);
  REQUIRE_MESSAGE(bundle.ok(), (bundle ? "" : bundle.error().message()));
  CHECK(resident() < before + (8 << 20) / 4096);
}

TEST_CASE("a text that is shown is at most 4096 bytes long, and a vocabulary as long as it is") {
  EditableBundle bundle = small_bundle();
  bundle.set("action.names", Value(std::vector<std::string>{std::string(4097, 'x')}));
  CHECK(contains(refusal(bundle.bytes()), "action.names: expected text of at most 4096 bytes, found 4097 bytes"));
  bundle.set("action.names", Value(std::vector<std::string>{std::string(4096, 'x')}));
  bundle.set("tokenizer.pre", Value(std::string(5000, 'x')));
  CHECK(parse(bundle.bytes()).ok());
}

}  // namespace bundle_test
