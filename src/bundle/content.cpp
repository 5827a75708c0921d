// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "bundle/content.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>
#include <xxhash.h>

#include <algorithm>
#include <cerrno>
#include <chrono>
#include <cstring>

namespace vla {
namespace {

constexpr std::size_t kPiece = std::size_t{1} << 20;  // bytes read at a time in a pass over a file
static_assert(kPiece % Content::kBlock == 0);
constexpr const char* kReplace = "replace a bundle by renaming a new file over it";

Error io_error(const std::string& path, const char* what) { return {Code::io, path, what, std::strerror(errno)}; }

/// Returns the number of bytes read: fewer than requested at the end of the file, -1 with errno set on failure.
ssize_t read_at(int file, std::size_t offset, std::span<std::byte> to) {
  std::size_t done = 0;
  while (done < to.size()) {
    const ssize_t got = ::pread(file, to.data() + done, to.size() - done, static_cast<off_t>(offset + done));
    if (got < 0 && errno == EINTR) continue;
    if (got < 0) return -1;
    if (got == 0) break;
    done += static_cast<std::size_t>(got);
  }
  return static_cast<ssize_t>(done);
}

}  // namespace

Result<std::shared_ptr<Content>> Content::open(const std::string& path) {
  // O_NONBLOCK: opening a pipe would wait for a writer. Regular files are not affected.
  const int file = ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
  if (file < 0) return io_error(path, "a readable bundle");
  const std::shared_ptr<Content> content(new Content(file, path));
  struct stat info = {};
  if (::fstat(file, &info) != 0 || !S_ISREG(info.st_mode))
    return Error{Code::io, path, "a file", "something that is not a regular file"};
  if (info.st_size == 0)
    return Error{Code::bad_bundle, path, "a GGUF file", "an empty file", "copy or convert it again"};
  const auto size = static_cast<std::size_t>(info.st_size);
  void* addresses = ::mmap(nullptr, size, PROT_NONE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
  if (addresses == MAP_FAILED)
    return Error{Code::out_of_memory, path, fmt::format("addresses for {} bytes", size), "fewer",
                 "use a smaller model"};
  content->bytes_ = {static_cast<const std::byte*>(addresses), size};
  return content;
}

Content::~Content() {
  if (file_ < 0) return;
  ::close(file_);
  if (!bytes_.empty()) ::munmap(const_cast<std::byte*>(bytes_.data()), bytes_.size());
}

/// Fills `to` from the file. A file that ends earlier is an error.
Status Content::fill(std::size_t offset, std::span<std::byte> to) const {
  const ssize_t got = read_at(file_, offset, to);
  if (got < 0) return io_error(path_, "a readable bundle");
  if (static_cast<std::size_t>(got) == to.size()) return {};
  return Error{Code::bad_bundle, path_, fmt::format("a file of {} bytes", bytes_.size()),
               fmt::format("one that ended at {} while it was read", offset + static_cast<std::size_t>(got)), kReplace};
}

Status Content::show(std::size_t n) {
  if (n <= shown_) return {};
  const std::size_t end = std::min(bytes_.size(), (n + kPiece - 1) / kPiece * kPiece);
  auto* const first = const_cast<std::byte*>(bytes_.data());
  if (::mprotect(first, end, PROT_READ | PROT_WRITE) != 0)
    return Error{Code::out_of_memory, path_, fmt::format("{} bytes of memory", end), "less", "free memory"};
  VLA_CHECK(fill(shown_, {first + shown_, end - shown_}));
  shown_ = end;
  return {};
}

Status Content::seal(const std::function<void(std::span<const std::byte>)>& see) {
  if (file_ < 0) {
    see(bytes_);
    return {};
  }
  const auto start = std::chrono::steady_clock::now();
  ReadBuffer buffer;
  sums_.reserve(bytes_.size() / kBlock + 1);
  for (std::size_t offset = 0; offset < bytes_.size(); offset += kPiece) {
    std::span<const std::byte> piece = bytes_.subspan(offset, std::min(kPiece, bytes_.size() - offset));
    if (offset >= shown_) {  // bytes before shown_ are in memory and are hashed as they were parsed
      const std::span<std::byte> to(buffer.take(kPiece), piece.size());
      VLA_CHECK(fill(offset, to));
      piece = to;
    }
    see(piece);
    for (std::size_t i = 0; i < piece.size(); i += kBlock)
      sums_.push_back(XXH3_64bits(piece.data() + i, std::min(kBlock, piece.size() - i)));
  }
  read_rate_ = static_cast<double>(bytes_.size()) /
               std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  auto* const first = const_cast<std::byte*>(bytes_.data());
  ::madvise(first, shown_, MADV_DONTNEED);
  ::mprotect(first, shown_, PROT_NONE);  // zeros would look like weights
  shown_ = 0;
  return {};
}

const std::byte* Content::read(std::span<const std::byte> part, ReadBuffer& buffer) const {
  if (file_ < 0 || part.empty()) return part.data();
  const auto offset = static_cast<std::size_t>(part.data() - bytes_.data());
  const std::size_t first = offset / kBlock * kBlock;
  const std::size_t end = std::min(bytes_.size(), (offset + part.size() + kBlock - 1) / kBlock * kBlock);
  const std::span<std::byte> blocks(buffer.take(end - first), end - first);
  if (read_at(file_, first, blocks) != static_cast<ssize_t>(blocks.size())) return nullptr;
  for (std::size_t i = 0; i < blocks.size(); i += kBlock)
    if (XXH3_64bits(&blocks[i], std::min(kBlock, blocks.size() - i)) != sums_[(first + i) / kBlock]) return nullptr;
  return &blocks[offset - first];
}

void Content::advise(std::span<const std::byte> part, int advice) const {
  if (file_ >= 0) ::posix_fadvise(file_, part.data() - bytes_.data(), static_cast<off_t>(part.size()), advice);
}
void Content::expect(std::span<const std::byte> part) const { advise(part, POSIX_FADV_WILLNEED); }
void Content::forget(std::span<const std::byte> part) const { advise(part, POSIX_FADV_DONTNEED); }

std::size_t Content::n_cached() const {
  if (file_ < 0) return 0;
  void* const addresses = ::mmap(nullptr, bytes_.size(), PROT_READ, MAP_SHARED, file_, 0);
  if (addresses == MAP_FAILED) return 0;
  const auto page = static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
  std::vector<unsigned char> pages((bytes_.size() + page - 1) / page);
  const bool is_known = ::mincore(addresses, bytes_.size(), pages.data()) == 0;
  ::munmap(addresses, bytes_.size());
  if (!is_known) return 0;
  return page *
         static_cast<std::size_t>(std::ranges::count_if(pages, [](unsigned char bits) { return bits % 2 == 1; }));
}

Error Content::changed() const {
  return {Code::bad_bundle, path_, "the bytes that were there when it was opened", "others", kReplace};
}

}  // namespace vla
