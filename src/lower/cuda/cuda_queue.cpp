// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "lower/cuda/cuda_queue.h"

#include <algorithm>
#include <cstring>

namespace vla::lower {
namespace {

/// Streams that a captured graph forks into: at most three products share an x, and four small kernels do not fill a
/// device.
constexpr std::size_t kStreams = 4;
/// Most nodes of a graph; drivers run out of memory with more. A longer act takes several launches.
constexpr std::size_t kMaxLaunches = 20000;
/// Capacity after the images for the other uploads of an act: tokens, state and noise.
constexpr std::size_t kRoom = std::size_t{256} << 10;

std::size_t n_launch(const CudaPart& part) {
  std::size_t n = 0;
  for (const auto& phase : part.phases)
    for (const Calls& calls : phase) n += calls.size();
  return n;
}

}  // namespace

Result<std::unique_ptr<CudaQueue>> CudaQueue::open(const cuda::Driver& driver, int index,
                                                   const std::vector<std::string>& modules) {
  VLA_TRY(std::unique_ptr<cuda::Gpu> gpu, cuda::Gpu::open(driver, index, modules));
  std::unique_ptr<CudaQueue> queue(new CudaQueue(std::move(gpu)));
  VLA_TRY(cuda::Stream main, queue->gpu_->stream());
  queue->main_ = std::make_unique<cuda::Stream>(std::move(main));
  while (queue->side_.size() + 1 < kStreams) {
    VLA_TRY(cuda::Stream side, queue->gpu_->stream());
    queue->side_.push_back(std::move(side));
  }
  VLA_TRY(queue->end_, queue->gpu_->event(true));
  VLA_TRY(queue->sender_, CudaSender::open(queue->gpu_));
  return queue;
}

CudaQueue::~CudaQueue() {
  if (gpu_) static_cast<void>(gpu_->use());
}

Result<std::shared_ptr<cuda::Buffer>> CudaQueue::allocate(std::size_t size, const std::string& what) {
  size = std::max<std::size_t>(size, 1);
  if (is_dry_) {
    const cuda::Address address = next_;
    next_ += device_aligned(size);
    return std::make_shared<cuda::Buffer>(nullptr, address, size);
  }
  VLA_CHECK(failure_);
  Result<cuda::Buffer> made = gpu_->allocate(size, what);
  if (made) return std::make_shared<cuda::Buffer>(std::move(*made));
  // Lack of memory may be temporary; a failed device stays failed.
  if (made.error().code != Code::out_of_memory) static_cast<void>(keep(made.error()));
  return made.error();
}

Status CudaQueue::fill_zeros(const cuda::Buffer& memory) {
  if (is_dry_) return {};
  VLA_CHECK(failure_);
  VLA_CHECK(keep(gpu_->use()));
  return keep(main_->fill(memory.address(), 0, memory.size()));
}

Result<cuda::Owned> CudaQueue::event() {
  if (is_dry_) return cuda::Owned();
  VLA_CHECK(failure_);
  VLA_CHECK(keep(gpu_->use()));
  Result<cuda::Owned> made = gpu_->event(true);
  if (!made) static_cast<void>(keep(made.error()));
  return made;
}

Status CudaQueue::keep(Status status) {
  if (!status && failure_) failure_ = status;
  return status;
}

Status CudaQueue::grow(HostMemory& memory, std::size_t size) {
  if (memory.size >= size) return {};
  VLA_TRY(memory.memory, gpu_->allocate_host(size));
  memory.size = size;
  return {};
}

void CudaQueue::set(cuda::Address to, const void* from, std::size_t size) {
  if (!is_dry_ && failure_) static_cast<void>(keep(stage(to, from, size)));
}

Status CudaQueue::stage(cuda::Address to, const void* from, std::size_t size) {
  VLA_CHECK(gpu_->use());
  VLA_CHECK(launch());  // queued work reads the old bytes
  VLA_TRY(std::shared_ptr<HostBlock> block, block_of(from));
  if (block) {
    uploads_.push_back({to, static_cast<std::byte*>(const_cast<void*>(from)), size, std::move(block)});
    return {};
  }
  if (join(to, from, size)) return {};
  if (n_staged_ + size + kDeviceAlignment > staging_.size) {  // grow until all inputs of an act fit
    const std::size_t enough = 2 * (n_staged_ + size) + kDeviceAlignment;
    VLA_CHECK(start_uploads());
    VLA_CHECK(wait());
    VLA_CHECK(grow(staging_, enough));
  }
  uploads_.push_back({to, staging_.at(n_staged_), size, nullptr});
  std::memcpy(staging_.at(n_staged_), from, size);
  n_staged_ += size;
  return {};
}

/// Adds bytes to the last copy, if they follow it but for the padding of a slot, and its memory has room for them.
bool CudaQueue::join(cuda::Address to, const void* from, std::size_t size) {
  if (uploads_.empty()) return false;
  Upload& last = uploads_.back();
  const HostMemory& memory = last.block ? last.block->memory : staging_;
  std::byte* const end = last.from + last.size;
  const std::size_t gap = to - (last.to + last.size);  // very large if they come before it
  if (gap >= kDeviceAlignment || end + gap + size > memory.at(memory.size)) return false;
  std::memset(end, 0, gap);
  std::memcpy(end + gap, from, size);
  last.size += gap + size;
  if (!last.block) n_staged_ += gap + size;
  return true;
}

std::shared_ptr<std::byte> CudaQueue::host_memory(std::size_t size) {
  if (is_dry_) return nullptr;
  const std::lock_guard lock(blocks_mutex_);
  Result<std::shared_ptr<HostBlock>> made = make_block(size + kRoom);
  if (made) {
    std::byte* begin = (*made)->memory.at(0);
    return {std::move(*made), begin};
  }
  // Without page-locked memory, `set` copies the bytes to the staging buffer.
  if (made.error().code != Code::out_of_memory && block_failure_) block_failure_ = made.error();
  return nullptr;
}

Result<std::shared_ptr<CudaQueue::HostBlock>> CudaQueue::make_block(std::size_t size) {
  auto block = std::make_shared<HostBlock>(gpu_);
  VLA_CHECK(grow(block->memory, size));
  std::erase_if(blocks_, [](const auto& known) { return known.expired(); });
  blocks_.push_back(block);
  return block;
}

/// The block that `from` lies in, or null.
Result<std::shared_ptr<CudaQueue::HostBlock>> CudaQueue::block_of(const void* from) {
  const std::lock_guard lock(blocks_mutex_);
  VLA_CHECK(block_failure_);
  for (const auto& known : blocks_)
    if (std::shared_ptr<HostBlock> block = known.lock())
      if (from >= block->memory.at(0) && from < block->memory.at(block->memory.size)) return block;
  return std::shared_ptr<HostBlock>();
}

std::unique_ptr<CudaSent> CudaQueue::send(const void* data, std::size_t size) {
  return is_dry_ || size == 0 ? nullptr : sender_->send(data, size);
}

void CudaQueue::take(cuda::Address to, const CudaSent& sent, std::size_t size) {
  if (failure_) static_cast<void>(keep(copy(to, sent, size)));
}

Status CudaQueue::copy(cuda::Address to, const CudaSent& sent, std::size_t size) {
  VLA_CHECK(sent.status());
  VLA_CHECK(gpu_->use());
  VLA_CHECK(launch());  // queued work reads the old bytes
  VLA_CHECK(start_uploads());
  VLA_CHECK(main_->after(sent.arrived()));
  return main_->copy(to, sent.address(), size);
}

Status CudaQueue::upload(cuda::Address to, const void* from, std::size_t size) {
  if (is_dry_) return {};
  VLA_CHECK(failure_);
  VLA_CHECK(keep(gpu_->use()));
  VLA_CHECK(keep(main_->upload(to, from, size)));
  return keep(wait());
}

Status CudaQueue::run(const CudaPart& part) {
  VLA_CHECK(failure_);
  if (is_dry_) return Error{Code::internal, "cuda", "a device with memory", "a dry one"};
  const std::size_t n = n_launch(part);
  if (n == 0 && part.marks.empty()) return {};
  if (n_pending_ > 0 && n_pending_ + n > kMaxLaunches) VLA_CHECK(keep(launch()));
  pending_.push_back(&part), n_pending_ += n;
  return {};
}

void CudaQueue::get(void* to, cuda::Address from, std::size_t size) {
  if (!is_dry_ && failure_) static_cast<void>(keep(download(to, from, size)));
}

Status CudaQueue::download(void* to, cuda::Address from, std::size_t size) {
  VLA_CHECK(gpu_->use());
  VLA_CHECK(launch());
  VLA_CHECK(start_uploads());
  VLA_CHECK(grow(landing_, size));
  VLA_CHECK(main_->download(landing_.at(0), from, size));
  VLA_CHECK(wait());
  std::memcpy(to, landing_.at(0), size);
  return note_times();
}

Status CudaQueue::flush() {
  VLA_CHECK(failure_);
  return keep(launch());
}

Status CudaQueue::record(const cuda::Owned& event) {
  VLA_CHECK(gpu_->use());
  return main_->record(event);
}

Status CudaQueue::start_uploads() {
  for (const Upload& upload : uploads_) VLA_CHECK(main_->upload(upload.to, upload.from, upload.size));
  for (Upload& upload : uploads_)
    if (upload.block) read_.push_back(std::move(upload.block));
  uploads_.clear();
  return {};
}

Status CudaQueue::launch() {
  if (pending_.empty()) return {};
  VLA_CHECK(gpu_->use());
  VLA_CHECK(start_uploads());
  const Parts parts = std::move(pending_);
  pending_.clear(), n_pending_ = 0;
  if (!graphs_.contains(parts)) VLA_CHECK(capture(parts));
  VLA_CHECK(main_->launch(graphs_.at(parts)));
  launched_.insert(launched_.end(), parts.begin(), parts.end());
  return {};
}

Status CudaQueue::wait() {
  VLA_CHECK(main_->wait());
  read_.clear();
  if (uploads_.empty()) n_staged_ = 0;
  return {};
}

/// Converts the marks' device times to host times, relative to the end of the wait.
Status CudaQueue::note_times() {
  const auto now = std::chrono::steady_clock::now();
  const Parts parts = std::move(launched_);
  launched_.clear();
  for (const CudaPart* part : parts)
    for (const CudaPart::Mark& mark : part->marks) {
      VLA_TRY(const float ms, gpu_->elapsed(mark.event, end_));
      *mark.time = now - std::chrono::duration_cast<std::chrono::nanoseconds>(
                             std::chrono::duration<float, std::milli>(std::max(ms, 0.0f)));
    }
  return {};
}

Status CudaQueue::capture(const Parts& parts) {
  for (const CudaPart* part : parts)
    for (const auto& phase : part->phases)
      for (const Calls& calls : phase)
        for (const Call& call : calls) VLA_CHECK(gpu_->prepare(call.how));
  VLA_CHECK(main_->begin_capture());
  for (const CudaPart* part : parts) VLA_CHECK(capture(*part));
  VLA_CHECK(main_->note_time(end_));
  VLA_TRY(graphs_[parts], main_->end_capture());
  return {};
}

/// Spreads the operations of each phase over the streams.
Status CudaQueue::capture(const CudaPart& part) {
  auto mark = part.marks.begin();
  for (std::size_t phase = 0; phase <= part.phases.size(); ++phase) {
    for (; mark != part.marks.end() && mark->n_phase == phase; ++mark) VLA_CHECK(main_->note_time(mark->event));
    if (phase == part.phases.size()) break;
    const std::vector<Calls>& operations = part.phases[phase];
    const std::size_t n_stream = std::min(operations.size(), kStreams);
    for (std::size_t i = 1; i < n_stream; ++i) VLA_CHECK(side_[i - 1].after(*main_));
    for (std::size_t i = 0; i < operations.size(); ++i) {
      cuda::Stream& stream = i % n_stream == 0 ? *main_ : side_[i % n_stream - 1];
      for (const Call& call : operations[i]) VLA_CHECK(stream.launch_job(call.how, call.job.data()));
    }
    for (std::size_t i = 1; i < n_stream; ++i) VLA_CHECK(main_->after(side_[i - 1]));
  }
  return {};
}

void CudaQueue::forget(const CudaPart& part) {
  const auto has = [&](const Parts& parts) { return std::ranges::find(parts, &part) != parts.end(); };
  if (failure_ && (has(pending_) || has(launched_))) {
    static_cast<void>(keep(launch()));
    static_cast<void>(keep(wait()));
  }
  if (gpu_) static_cast<void>(gpu_->use());
  std::erase(pending_, &part), std::erase(launched_, &part);
  std::erase_if(graphs_, [&](const auto& graph) { return has(graph.first); });
}

}  // namespace vla::lower
