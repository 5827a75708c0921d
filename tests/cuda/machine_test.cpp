// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "cuda/machine.h"

#include <doctest/doctest.h>

#include <functional>

#include "cuda/fault.h"
#include "cuda/fragments.h"
#include "cuda/machine_kernels.h"
#include "cuda/ptx.h"

namespace machine_test {

using namespace vla;
using namespace vla::test::cuda;

namespace {

std::string fault_of(const std::function<void()>& act) {
  try {
    act();
  } catch (const Fault& fault) {
    return fault.what();
  }
  return "";
}
bool contains(const std::string& text, const std::string& part) { return text.find(part) != std::string::npos; }

/// A kernel `k` whose one parameter is an address of 32 words, %rd1; registers r1 to r9, p1 to p3, f1 to f3 are free.
std::string kernel_of(const std::string& body) {
  return ".version 9.0\n.target sm_80\n.address_size 64\n.extern .shared .align 16 .b8 room[];\n"
         ".visible .entry k(\n.param .u64 k_param_0\n)\n{\n.reg .pred %p<4>;\n.reg .b32 %r<10>;\n.reg .f32 "
         "%f<8>;\n.reg .b64 %rd<6>;\n"
         "ld.param.u64 %rd1, [k_param_0];\nmov.u32 %r1, %tid.x;\nmul.wide.u32 %rd2, %r1, 4;\nadd.s64 %rd3, %rd1, "
         "%rd2;\n" +
         body + "\nret;\n}\n";
}
std::vector<std::uint32_t> run_body(const std::string& body, unsigned n_thread, Extent grid) {
  const PtxModule module(kernel_of(body));
  const Device<std::uint32_t> y(64);
  std::uint32_t* p = y.get();
  device_memory().begin_launch();
  run_ptx(*module.find("k"), grid, n_thread, 512, &p);
  return y.host();
}
std::vector<std::uint32_t> run_body(const std::string& body, unsigned n_thread = 32, unsigned n_block = 1) {
  return run_body(body, n_thread, {n_block, 1, 1});
}
std::string fault_of_body(const std::string& body, unsigned n_thread = 32, unsigned n_block = 1) {
  return fault_of([&] { run_body(body, n_thread, n_block); });
}

}  // namespace

TEST_CASE("each mistake of a kernel is a fault that says what is wrong, and threads that behave have none") {
  if (runs_ptx()) return;  // these kernels are the host compiler's; those below are PTX
  const Device<int> x(4), y(64);
  const auto fault = [&](Mistake mistake) {
    const vla::cuda::MisbehaveJob job = {mistake, x.get(), y.get()};
    return fault_of([&] { launch({"misbehave", {}, 64, 1024}, job); });
  };
  in_every_schedule([&] {
    CHECK(fault(Mistake::none).empty());
    for (int i = 0; i < 64; ++i) REQUIRE(y.host()[static_cast<std::size_t>(i)] == 63 - i);
    CHECK(contains(fault(Mistake::no_barrier), "race in shared memory"));
    CHECK(contains(fault(Mistake::no_warp_barrier), "race in shared memory"));
    CHECK(contains(fault(Mistake::write_after_read), "race in shared memory"));
    CHECK(contains(fault(Mistake::no_wait), "has not brought"));
    CHECK(!fault(Mistake::wait_without_barrier).empty());  // as threads come: a race, or a copy on its way
    CHECK(contains(fault(Mistake::behind_shared), "not in shared memory"));
    CHECK(contains(fault(Mistake::not_aligned), "not aligned"));
    CHECK(contains(fault(Mistake::some_lanes_shuffle), "every thread waits"));
    CHECK(contains(fault(Mistake::some_warps_wait), "every thread waits"));
    CHECK(contains(fault(Mistake::different_instructions), "different instructions"));
  });
}

TEST_CASE("each mistake of blocks of a cluster is a fault that says what is wrong, in any order of their threads") {
  if (runs_ptx()) return;
  const Device<int> x(4), y(128);
  const auto fault = [&](Mistake mistake) {
    const vla::cuda::MisbehaveJob job = {mistake, x.get(), y.get()};
    return fault_of([&] { launch({"misbehave", {1, 1, 2}, 64, 1024, 2}, job); });
  };
  in_every_schedule([&] {
    CHECK(fault(Mistake::no_mistake_of_cluster).empty());
    for (int i = 0; i < 128; ++i) REQUIRE(y.host()[static_cast<std::size_t>(i)] == (i < 64 ? 100 + i : i - 64));
    CHECK(contains(fault(Mistake::no_cluster_barrier), "before a barrier of the cluster"));
    CHECK(contains(fault(Mistake::barrier_of_block), "before a barrier of the cluster"));
    CHECK(contains(fault(Mistake::barrier_releases_nothing), "before a barrier of the cluster"));
    CHECK(contains(fault(Mistake::write_after_barrier), "race in shared memory"));
    CHECK(contains(fault(Mistake::write_of_what_is_read), "race in shared memory"));
    CHECK(contains(fault(Mistake::read_of_ended_block), "ended") !=
          contains(fault(Mistake::read_of_ended_block), "ends while another block"));
    CHECK(contains(fault(Mistake::some_threads_leave), "wait at a barrier of the cluster"));
    CHECK(contains(fault(Mistake::no_such_block), "no such block"));
  });
}

namespace {

constexpr int kMapColumns = 64;
/// Rows whose numbers all differ, as bf16 has bits.
std::vector<std::uint16_t> numbered_rows(int n_row) {
  std::vector<std::uint16_t> rows(static_cast<std::size_t>(n_row * kMapColumns));
  for (std::size_t i = 0; i < rows.size(); ++i) rows[i] = static_cast<std::uint16_t>(i + 1);
  return rows;
}
/// The word at an address of shared memory where boxes of such rows begin, the first at a row.
std::uint32_t word_of_box(const std::vector<std::uint16_t>& rows, std::size_t at, int first_row) {
  const std::size_t row = at / 128, chunk = at % 128 / 16 ^ row % 8;
  const std::size_t i = (static_cast<std::size_t>(first_row) + row) * kMapColumns + chunk * 8 + at % 16 / 2;
  return rows[i] | static_cast<std::uint32_t>(rows[i + 1]) << 16;
}

}  // namespace

TEST_CASE("copies that mbarriers count: each mistake is a fault, whenever copies arrive") {
  if (runs_ptx()) return;
  using Job = vla::cuda::MisbehaveCopyJob;
  constexpr int kRows = 2 * Job::kBoxRows * Job::kRounds;
  const std::vector<std::uint16_t> rows = numbered_rows(kRows);
  const Device<std::uint16_t> x(rows);
  const Device<unsigned> y(64);
  const auto fault = [&](Mistake mistake) {
    const Job job = {map_rows({x.get(), kRows, kMapColumns, kMapColumns, Job::kBoxRows}), mistake, y.get()};
    return fault_of([&] { launch({"misbehave_with_copies", {1, 1, 2}, 64, 2048 + 16, 2}, job); });
  };
  in_every_schedule([&] {
    CHECK(fault(Mistake::no_mistake_with_mbarriers) == "");
    for (std::size_t i = 0; i < 64; ++i) {
      std::uint32_t sum = 0;
      for (int round = 0; round < Job::kRounds; ++round)
        sum += word_of_box(rows, i % 32 * 64, 2 * round * Job::kBoxRows);
      REQUIRE(y.host()[i] == sum);
    }
    CHECK(contains(fault(Mistake::no_fence_of_mbarriers), "no fence has made visible"));
    CHECK(!fault(Mistake::no_barrier_after_begin).empty());  // as threads come: not begun, or not visible
    // As threads come: what a copy brings is read too early, or written while it is read, or a phase ends too early.
    for (const Mistake mistake : {Mistake::no_wait_for_copies, Mistake::wait_for_other_parity,
                                  Mistake::nothing_expected, Mistake::too_few_bytes, Mistake::no_wait_for_readers,
                                  Mistake::arrival_before_read, Mistake::arrival_too_often})
      CHECK_MESSAGE(!fault(mistake).empty(), static_cast<int>(mistake));
    CHECK(contains(fault(Mistake::too_many_bytes), "never comes"));
    CHECK(contains(fault(Mistake::copy_to_one_block), "never comes"));
    CHECK(contains(fault(Mistake::arrival_without_warp_barrier), "a bulk copy writes what a thread reads"));
    CHECK(contains(fault(Mistake::arrival_at_one_block), "never comes"));
    CHECK(contains(fault(Mistake::end_without_others), "ended") !=
          contains(fault(Mistake::end_without_others), "ends while another block"));
    CHECK(contains(fault(Mistake::nobody_waits), "nobody has waited for"));
  });
}

TEST_CASE("a launch that a device would refuse is refused") {
  if (runs_ptx()) return;
  const int job = 0;
  const auto fault = [&](const vla::cuda::Launch& how) { return fault_of([&] { launch(how, &job, sizeof(job)); }); };
  CHECK(contains(fault({"absent", {}, 32, 0}), "no kernel"));
  CHECK(contains(fault({"misbehave", {}, 32, 0}), "job of another size"));
  CHECK(contains(fault({"misbehave", {0, 1, 1}, 32, 0}), "without blocks"));
  CHECK(contains(fault({"misbehave", {1, 65536, 1}, 32, 0}), "more blocks"));
  CHECK(contains(fault({"misbehave", {}, 32, 100 << 10}), "more shared memory"));
  CHECK(contains(fault({"misbehave", {1, 1, 3}, 32, 0, 2}), "does not divide the grid"));
  CHECK(contains(fault({"misbehave", {1, 1, 9}, 32, 0, 9}), "a cluster that no device has"));
}

TEST_CASE("PTX that is not known is refused by name when it is read") {
  const auto refused = [](const std::string& body) { return fault_of([&] { PtxModule module(kernel_of(body)); }); };
  CHECK(contains(refused("bfind.u32 %r2, %r1;"), "unknown instruction bfind.u32"));
  CHECK(contains(refused("ld.local.u32 %r2, [%rd1];"), "unknown instruction ld.local.u32"));
  CHECK(contains(refused("atom.global.add.u32 %r2, [%rd1], %r1;"), "unknown instruction atom.global.add.u32"));
  CHECK(contains(refused("st.shared::cluster.u32 [%r1], %r2;"), "unknown instruction st.shared::cluster.u32"));
  CHECK(contains(refused("barrier.cluster.arrive;"), "unknown instruction barrier.cluster.arrive"));
  CHECK(contains(refused("add.s32 %r2, %r1;"), "number of operands"));
  CHECK(contains(refused("add.s32 %r2, %r1, %rd1;"), "%rd1 is no register of the operation's type"));
  CHECK(contains(refused("add.s32 %r2, %r1, %r99;"), "unknown register %r99"));
  CHECK(contains(refused("add.s32 %r2, %r1, %clock;"), "unknown register %clock"));
  CHECK(contains(refused("bra $nowhere;"), "no label $nowhere"));
  CHECK(contains(refused(".local .align 4 .b8 depot[16];"), "unknown directive .local"));
  CHECK(contains(fault_of([] { PtxModule module(".visible .entry k(\n.param .u64 k_param_0\n)\n{\nret;\n"); }),
                 "ends in the middle"));
}

TEST_CASE("lanes that part do each their own, and meet again") {
  // Even lanes count to their number, odd ones store 100 + it; then all shuffle.
  const std::vector<std::uint32_t> y = run_body(
      "and.b32 %r2, %r1, 1;\nmov.u32 %r3, 0;\nsetp.ne.s32 %p1, %r2, 0;\n@%p1 bra $odd;\n"
      "$loop:\nsetp.ge.s32 %p2, %r3, %r1;\n@%p2 bra $meet;\nadd.s32 %r3, %r3, 1;\nbra.uni $loop;\n"
      "$odd:\nadd.s32 %r3, %r1, 100;\n$meet:\nshfl.sync.bfly.b32 %r4|%p3, %r3, 1, 31, -1;\nst.global.u32 [%rd3], %r4;");
  for (std::uint32_t i = 0; i < 32; ++i) CHECK(y[i] == (i % 2 ? i - 1 : i + 101));
  CHECK(contains(
      fault_of_body(
          "setp.lt.s32 %p1, %r1, 16;\n@%p1 bra $skip;\nbar.warp.sync -1;\n$skip:\n@%p1 ret;\nbar.warp.sync -1;"),
      "lanes"));
}

TEST_CASE("PTX: accesses outside, not aligned, or of two blocks are faults with the instruction") {
  CHECK(contains(fault_of_body("st.global.u32 [%rd3+160], %r1;"),
                 "writes behind or before an allocation: st.global.u32"));
  CHECK(contains(fault_of_body("ld.global.u32 %r2, [%rd1+-4];"), "reads behind or before an allocation"));
  CHECK(contains(fault_of_body("ld.global.v2.u32 {%r2, %r3}, [%rd3];"), "not aligned"));
  CHECK(contains(fault_of_body("st.global.u32 [%rd3], %r1;", 32, 2), "two blocks of a launch"));
  CHECK(
      fault_of_body(
          "mov.u32 %r2, %ctaid.x;\nmul.wide.u32 %rd4, %r2, 128;\nadd.s64 %rd3, %rd3, %rd4;\nst.global.u32 [%rd3], %r1;",
          32, 2)
          .empty());
  CHECK(contains(fault_of_body("ld.param.u64 %rd4, [k_param_0+8];"), "behind the parameter"));
}

TEST_CASE("PTX: races in shared memory, and barriers that some miss") {
  const std::string own = "mov.u32 %r8, room;\nshl.b32 %r2, %r1, 2;\nadd.s32 %r2, %r2, %r8;\nxor.b32 %r3, %r2, ";
  const std::string of_warp = own + "4;\nst.shared.u32 [%r2], %r1;\n",
                    of_other = own + "128;\nst.shared.u32 [%r2], %r1;\n";
  const std::string read = "ld.shared.u32 %r4, [%r3];";
  CHECK(contains(fault_of_body(of_warp + read), "race in shared memory"));
  CHECK(fault_of_body(of_warp + "bar.warp.sync -1;\n" + read).empty());
  CHECK(contains(fault_of_body(of_other + "bar.warp.sync -1;\n" + read, 64), "race in shared memory"));
  CHECK(fault_of_body(of_other + "bar.sync 0;\n" + read, 64).empty());
  CHECK(contains(fault_of_body("setp.lt.s32 %p1, %r1, 32;\n@%p1 bra $end;\nbar.sync 0;\n$end:", 64),
                 "wait at a barrier"));
  const std::string copy =
      "mov.u32 %r8, room;\nshl.b32 %r2, %r1, 4;\nadd.s32 %r2, %r2, %r8;\nmov.u32 %r5, 16;\n"
      "cp.async.cg.shared.global [%r2], [%rd1], 16, %r5;\ncp.async.commit_group;\n";
  CHECK(contains(fault_of_body(copy + "ld.shared.u32 %r4, [%r2];"), "has not brought"));
  CHECK(contains(fault_of_body(copy + "cp.async.wait_group 1;\nld.shared.u32 %r4, [%r2];"), "has not brought"));
  CHECK(fault_of_body(copy + "cp.async.wait_group 0;\nld.shared.u32 %r4, [%r2];").empty());
}

TEST_CASE("PTX: blocks of a cluster read each other's shared memory between its barriers alone") {
  // %r2: where a thread writes its number plus 100 %r5; %r6: the same in the other block; %rd3: its word of y.
  const std::string begin =
      "mov.u32 %r8, room;\nshl.b32 %r2, %r1, 4;\nadd.s32 %r2, %r2, %r8;\nmov.u32 %r5, %ctaid.z;\n"
      "xor.b32 %r4, %r5, 1;\nmad.lo.s32 %r7, %r5, 100, %r1;\nmapa.shared::cluster.u32 %r6, %r2, %r4;\n"
      "mul.wide.u32 %rd4, %r5, 128;\nadd.s64 %rd3, %rd3, %rd4;\n";
  const std::string write = "st.shared.u32 [%r2], %r7;\n", read = "ld.shared::cluster.u32 %r3, [%r6];\n",
                    store = "st.global.u32 [%rd3], %r3;\n", wait = "barrier.cluster.wait.acquire.aligned;\n",
                    meet = "barrier.cluster.arrive.release.aligned;\n" + wait,
                    leave = "barrier.cluster.arrive.relaxed.aligned;\n" + wait;
  const auto run = [&](const std::string& body, unsigned n_thread = 32) {
    return run_body(begin + body, n_thread, {1, 1, 2, 2});
  };
  const auto fault = [&](const std::string& body, unsigned n_thread = 32) {
    return fault_of([&] { run(body, n_thread); });
  };
  in_every_schedule([&] {
    const std::vector<std::uint32_t> y = run(write + meet + read + leave + store);
    for (std::uint32_t i = 0; i < 64; ++i) REQUIRE(y[i] == (i < 32 ? 100 + i : i - 32));
    const std::vector<std::uint32_t> four =
        run("st.shared.v4.u32 [%r2], {%r5, %r1, %r7, %r7};\n" + meet +
            "ld.shared::cluster.v4.u32 {%r3, %r4, %r3, %r9}, [%r6];\n" + leave + store);
    CHECK(four == y);
    CHECK(contains(fault(write + read + leave), "before a barrier of the cluster"));
    CHECK(contains(fault(write + "bar.sync 0;\n" + read + leave), "before a barrier of the cluster"));
    CHECK(contains(fault(write + leave + read + leave), "before a barrier of the cluster"));
    CHECK(contains(fault(meet + write + read + leave), "race in shared memory"));
    CHECK(contains(fault(write + meet + read + write + leave), "race in shared memory"));
    CHECK(fault(write + meet + read + meet + write).empty());
    CHECK(contains(fault(write + meet + read + leave + write), "race in shared memory"));
    CHECK(!fault(write + meet + read + store).empty());  // one ends first: before it is read, or after
    CHECK(contains(fault(write + meet + "setp.eq.s32 %p1, %r5, 1;\n@%p1 bra $end;\n" + leave + "$end:"),
                   "some blocks end while others wait at a barrier of the cluster"));
    CHECK(contains(fault("setp.lt.s32 %p1, %r1, 32;\n@%p1 bra $end;\n" + meet + "$end:", 64), "wait at a barrier"));
    CHECK(contains(
        fault("setp.lt.s32 %p1, %r1, 32;\n@%p1 bra $other;\n" + meet + "bra $end;\n$other:\n" + "bar.sync 0;\n$end:",
              64),
        "different barriers"));
  });
  CHECK(contains(fault("barrier.cluster.arrive.release.aligned;\n" + read + wait), "does not wait there"));
  CHECK(contains(fault(wait), "the other way round"));
  CHECK(contains(fault(meet + "ld.shared::cluster.u32 %r3, [%r2];\n" + leave), "mapa has not made"));
  CHECK(contains(fault("mov.u32 %r4, 2;\nmapa.shared::cluster.u32 %r6, %r2, %r4;\n"), "no such block"));
  CHECK(contains(fault(write + meet + "ld.shared::cluster.u32 %r3, [%r6+512];\n"), "not in shared memory"));
}

TEST_CASE("PTX: a copy of a box is swizzled, has zeros outside of the rows, and is read once its mbarrier says so") {
  constexpr int kRows = 12, kDepth = 61;
  const std::vector<std::uint16_t> rows = numbered_rows(kRows);
  const Device<std::uint16_t> x(rows);
  struct alignas(64) Job {
    vla::cuda::TensorMap map;
    std::uint32_t* y;
  };
  const std::string
      begin =
          "ld.param.u64 %rd1, [k_param_0+128];\nmov.b64 %rd4, k_param_0;\ncvta.param.u64 %rd4, %rd4;\n"
          "mov.u32 %r1, %tid.x;\nmov.u32 %r8, room;\nshl.b32 %r2, %r1, 2;\nadd.s32 %r2, %r2, %r8;\n"
          "mul.wide.u32 %rd2, %r1, 4;\nadd.s64 %rd3, %rd1, %rd2;\nadd.s32 %r7, %r8, 2048;\nmov.u32 %r9, 0;\n"
          "setp.eq.s32 %p1, %r1, 0;\n",
      init = "@%p1 mbarrier.init.shared::cta.b64 [%r7], 1;\n", fence = "@%p1 fence.mbarrier_init.release.cluster;\n",
      barrier = "bar.sync 0;\n",
      copy =
          "@%p1 cp.async.bulk.tensor.2d.shared::cluster.global.mbarrier::complete_tx::bytes [%r8], "
          "[%rd4, {%r5, %r6}], [%r7];\n",
      wait = "$wait:\nmbarrier.try_wait.parity.shared::cta.b64 %p2, [%r7], %r9;\n@!%p2 bra $wait;\n",
      read = "ld.shared.u32 %r4, [%r2];\nst.global.u32 [%rd3], %r4;\n";
  const auto expect = [](int n_byte) {
    return "@%p1 mbarrier.arrive.expect_tx.shared::cta.b64 _, [%r7], " + std::to_string(n_byte) + ";\n";
  };
  const auto at = [](int column, int row) {
    return "mov.u32 %r5, " + std::to_string(column) + ";\nmov.u32 %r6, " + std::to_string(row) + ";\n";
  };
  const Device<std::uint32_t> y(256);
  const auto run = [&](const std::string& body) {
    const PtxModule module(
        ".version 9.0\n.target sm_80\n.address_size 64\n.extern .shared .align 16 .b8 room[];\n"
        ".visible .entry k(\n.param .align 64 .b8 k_param_0[192]\n)\n{\n.reg .pred %p<4>;\n.reg .b32 %r<10>;\n"
        ".reg .b64 %rd<6>;\n" +
        begin + body + "\nret;\n}\n");
    const Job job = {map_rows({x.get(), kRows, kDepth, kMapColumns, 8}), y.get()};
    device_memory().begin_launch();
    run_ptx(*module.find("k"), {1, 1, 1}, 256, 2048 + 8, &job);
  };
  const auto fault = [&](const std::string& body) { return fault_of([&] { run(body); }); };
  const std::string begun = init + fence + barrier + at(0, 0);
  in_every_schedule([&] {
    for (const auto& [column, row] : {std::pair{0, 0}, {0, 8}, {8, 4}, {-8, -4}, {64, 0}, {0, 12}}) {
      run(init + fence + barrier + at(column, row) + expect(1024) + copy + wait + read);
      const std::vector<std::uint32_t> found = y.host();
      for (int i = 0; i < 512; ++i) {
        const int box_row = i / 64, k = column + ((i % 64 / 8) ^ box_row) * 8 + i % 8, r = row + box_row;
        const bool is_inside = k >= 0 && k < kDepth && r >= 0 && r < kRows;
        const std::uint32_t half = found[static_cast<std::size_t>(i / 2)] >> i % 2 * 16 & 0xffff;
        REQUIRE(half == (is_inside ? rows[static_cast<std::size_t>(r * kMapColumns + k)] : 0));
      }
    }
    // As warps come: read too early, written while it is read, or a phase that never comes.
    CHECK(!fault(begun + expect(1024) + copy + read + wait).empty());
    CHECK(!fault(begun + "mov.u32 %r9, 1;\n" + expect(1024) + copy + wait + read).empty());
    CHECK(contains(fault(begun + expect(1040) + copy + wait + read), "never comes"));
    CHECK(contains(fault(begun + expect(1008) + copy + wait + read), "never comes"));
    CHECK(contains(fault(begun + copy + wait + read), "never comes"));
    CHECK(contains(fault(begun + expect(1024) + copy), "nobody has waited for"));
    CHECK(contains(fault(begun + expect(1024) + copy + wait + read + expect(1024) + copy + "mov.u32 %r9, 1;\n" +
                         "$again:\nmbarrier.try_wait.parity.shared::cta.b64 %p2, [%r7], %r9;\n@!%p2 bra $again;\n"),
                   "a bulk copy writes what a thread reads"));
  });
  CHECK(contains(fault(begun + expect(1024) + copy + read + wait), "has not waited"));
  CHECK(fault(begun + expect(1024) + copy + wait + read + barrier + expect(1024) + copy + "mov.u32 %r9, 1;\n" +
              "$again:\nmbarrier.try_wait.parity.shared::cta.b64 %p2, [%r7], %r9;\n@!%p2 bra $again;\n") == "");
  CHECK(contains(fault(init + barrier + at(0, 0) + expect(1024) + copy + wait), "no fence has made visible to copies"));
  CHECK(
      contains(fault(init + fence + at(0, 0) + expect(1024) + copy + wait), "an mbarrier that another thread begins"));
  CHECK(contains(fault(begun + init), "as plain memory"));
  CHECK(contains(fault(begun + "st.shared.u32 [%r7+4], %r1;\n"), "as plain memory"));
  CHECK(contains(fault(at(0, 0) + expect(1024)), "no mbarrier has begun there"));
  CHECK(contains(fault(begun + expect(0) + expect(0) + "mov.u32 %r9, 2;\n" + wait), "neither 0 nor 1"));
  CHECK(contains(fault(begun + expect(16) + expect(0)), "more often than it counts"));
  CHECK(contains(fault(begun + expect(1 << 20)), "more bytes than an mbarrier counts"));
  CHECK(contains(fault(begun + "add.s64 %rd4, %rd4, 8;\n" + copy), "a tensor map that is not aligned"));
  CHECK(contains(fault(begun + "add.s64 %rd4, %rd4, 64;\n" + copy), "no tensor map that a driver has made"));
  CHECK(contains(fault(begun + "add.s32 %r8, %r8, 64;\n" + copy), "an address that is not aligned"));
  CHECK(contains(fault("@%p1 st.shared.u32 [%r8], %r1;\n" + begun + expect(1024) + copy + wait),
                 "without fence.proxy.async"));
  CHECK(fault("@%p1 st.shared.u32 [%r8], %r1;\nfence.proxy.async.shared::cta;\n" + begun + expect(1024) + copy +
              wait) == "");
}

TEST_CASE("PTX: products of a warpgroup whose operands or sums are not ready, or touched too early") {
  // Thread t writes 16 bytes of a and 16 of b, rows of 128 bytes in 8 KB and 1 KB: zeros. Sums are ones.
  const std::string sums = "{%f0, %f1, %f2, %f3}";
  const std::string operands =
      "mov.u32 %r8, room;\nmov.u32 %r9, 0;\nshl.b32 %r2, %r1, 7;\nadd.s32 %r2, %r2, %r8;\n"
      "st.shared.v4.u32 [%r2], {%r9, %r9, %r9, %r9};\nst.shared.v4.u32 [%r2+16], {%r9, %r9, %r9, %r9};\n"
      "cvt.u64.u32 %rd4, %r8;\nshr.u64 %rd4, %rd4, 4;\nor.b64 %rd4, %rd4, 4611686293305360384;\n"
      "mov.f32 %f0, 0f3f800000;\nmov.f32 %f1, %f0;\nmov.f32 %f2, %f0;\nmov.f32 %f3, %f0;\n"
      "mov.u32 %r3, 1;\nsetp.ne.b32 %p1, %r3, 0;\n";
  const std::string visible = "fence.proxy.async.shared::cta;\n", barrier = "bar.sync 0;\n",
                    fence = "wgmma.fence.sync.aligned;\n",
                    multiply = "wgmma.mma_async.sync.aligned.m64n8k16.f32.bf16.bf16 " + sums +
                               ", %rd4, %rd4, %p1, 1, 1, 0, 0;\n",
                    commit = "wgmma.commit_group.sync.aligned;\n", wait = "wgmma.wait_group.sync.aligned 0;\n",
                    store = "setp.lt.s32 %p2, %r1, 32;\n@%p2 st.global.f32 [%rd3], %f1;\n";
  const auto fault = [&](const std::string& body) {
    return fault_of([&] {
      const PtxModule module(kernel_of(operands + body));
      const Device<std::uint32_t> y(64);
      std::uint32_t* p = y.get();
      device_memory().begin_launch();
      run_ptx(*module.find("k"), {1, 1, 1}, 128, 16 << 10, &p);
      CHECK(y.host()[0] == 0x3f800000);
    });
  };
  in_every_schedule([&] {
    CHECK(fault(visible + barrier + fence + multiply + commit + wait + store).empty());
    CHECK(contains(fault(barrier + fence + multiply + commit + wait + store), "no fence.proxy.async has made visible"));
    CHECK(contains(fault(visible + fence + multiply + commit + wait + store), "race in shared memory"));
    CHECK(contains(fault(visible + barrier + multiply + commit + wait + store), "without wgmma.fence"));
    CHECK(contains(fault(visible + barrier + fence + multiply + commit + store + wait), "has not waited for"));
    CHECK(
        !fault(visible + barrier + fence + multiply + wait + store).empty());  // as warps come: touched, or never ended
    CHECK(contains(fault(visible + barrier + fence + multiply + commit), "while wgmma is under way"));
    CHECK(contains(fault(visible + barrier + fence + multiply + commit + "st.shared.u32 [%r2], %r9;\n" + wait),
                   "writes what wgmma reads"));
    CHECK(contains(fault(visible + barrier + "shl.b64 %rd4, %rd4, 1;\n" + fence + multiply + commit + wait),
                   "matrix descriptor"));
  });
}

TEST_CASE("PTX: products of a warpgroup with operand a in registers and a transposed b") {
  // b[16][16] = k + 2 n, in rows of 32 bytes, of which thread t writes word t. Row r of a has a one at r % 16.
  const std::string write_b =
      "mov.u32 %r8, room;\nshr.u32 %r2, %r1, 3;\nand.b32 %r3, %r1, 7;\nshl.b32 %r3, %r3, 2;\nadd.s32 %r2, %r2, %r3;\n"
      "cvt.rn.f32.s32 %f0, %r2;\nadd.s32 %r2, %r2, 2;\ncvt.rn.f32.s32 %f1, %r2;\ncvt.rn.bf16x2.f32 %r2, %f1, %f0;\n"
      "shl.b32 %r3, %r1, 2;\nshr.u32 %r9, %r3, 7;\nand.b32 %r9, %r9, 1;\nshl.b32 %r9, %r9, 4;\n"
      "xor.b32 %r3, %r3, %r9;\nadd.s32 %r3, %r3, %r8;\nst.shared.u32 [%r3], %r2;\nfence.proxy.async.shared::cta;\n"
      "bar.sync 0;\n";
  const std::string make_a =
      "shr.u32 %r2, %r1, 2;\nand.b32 %r2, %r2, 7;\nand.b32 %r3, %r2, 1;\nshl.b32 %r3, %r3, 4;\nshr.u32 %r2, %r2, 1;\n"
      "mov.u32 %r9, 16256;\nshl.b32 %r3, %r9, %r3;\nand.b32 %r9, %r1, 3;\nsetp.eq.s32 %p1, %r2, %r9;\n"
      "selp.b32 %r4, %r3, 0, %p1;\nmov.u32 %r5, 0;\nmov.u32 %r6, 0;\nmov.u32 %r7, %r4;\n";
  std::string begin = "cvt.u64.u32 %rd4, %r8;\nshr.u64 %rd4, %rd4, 4;\n";
  for (int i = 0; i < 8; ++i) begin += "mov.f32 %f" + std::to_string(i) + ", 0f3f800000;\n";
  const auto described = [](int swizzling, int stride) {
    const std::uint64_t bits = static_cast<std::uint64_t>(swizzling) << 62 | static_cast<std::uint64_t>(stride) << 32;
    return "or.b64 %rd4, %rd4, " + std::to_string(static_cast<std::int64_t>(bits)) + ";\n";
  };
  const auto multiply = [](const char* a, const char* tail) {
    return std::string(
               "wgmma.mma_async.sync.aligned.m64n16k16.f32.bf16.bf16 {%f0, %f1, %f2, %f3, %f4, %f5, %f6, %f7}, ") +
           a + ", %rd4, %p2, " + tail + ";\n";
  };
  const std::string fence = "wgmma.fence.sync.aligned;\n", commit = "wgmma.commit_group.sync.aligned;\n",
                    wait = "wgmma.wait_group.sync.aligned 0;\n", adds = "setp.eq.u32 %p2, 0, 0;\n",
                    of_a = multiply("{%r4, %r5, %r6, %r7}", "1, 1, 1"), narrow = described(3, 16),
                    store =
                        "setp.lt.s32 %p3, %r1, 32;\n@%p3 st.global.f32 [%rd3], %f1;\n@%p3 st.global.f32 "
                        "[%rd3+128], %f6;\n";
  const std::string before = write_b + make_a + begin + adds;
  std::vector<float> y;
  const auto fault = [&](const std::string& body) {
    return fault_of([&] {
      const PtxModule module(kernel_of(before + body));
      const Device<float> to(64);
      float* p = to.get();
      device_memory().begin_launch();
      run_ptx(*module.find("k"), {1, 1, 1}, 128, 1 << 10, &p);
      y = to.host();
    });
  };
  in_every_schedule([&] {
    CHECK(fault(narrow + fence + of_a + commit + wait + store).empty());
    for (int l = 0; l < kWarp; ++l) {
      const auto lane = static_cast<std::size_t>(l);
      CHECK(y[lane] == static_cast<float>(1 + l / 4 + 2 * (l % 4 * 2 + 1)));
      CHECK(y[32 + lane] == static_cast<float>(1 + l / 4 + 8 + 2 * (8 + l % 4 * 2)));
    }
    CHECK(contains(fault(narrow + fence + of_a + commit + "add.s32 %r4, %r4, 1;\n" + wait), "has not waited for"));
    CHECK(contains(fault(narrow + fence + of_a + commit + "add.s32 %r9, %r7, 1;\n" + wait), "has not waited for"));
    CHECK(
        contains(fault(narrow + fence + "add.s32 %r4, %r4, 1;\n" + of_a + commit + wait), "without wgmma.fence after"));
    CHECK(contains(fault(narrow + "add.s64 %rd4, %rd4, 2;\n" + fence + of_a + commit + wait), "between eight rows"));
    CHECK(contains(fault(described(1, 64) + fence + of_a + commit + wait), "a part of a row"));
    CHECK(contains(fault(described(2, 32) + fence + of_a + commit + wait), "without swizzling over 128 or 32"));
  });
  CHECK(contains(fault(multiply("{%r4, %r5, %r6, %r7}", "1, 1, 0, 1")), "number of operands"));
  CHECK(contains(fault(multiply("{%r4, %r5, %r6, %r7}", "1, -1, 1")), "negates"));
  CHECK(contains(fault(multiply("%rd4", "1, 1, 1, 0")), "transposes a"));
}

TEST_CASE("bank conflicts are counted as lanes that wait") {
  const auto conflicts = [](int factor, int width) {
    counts = {};
    std::size_t offsets[kWarp];
    for (int l = 0; l < kWarp; ++l) offsets[l] = static_cast<std::size_t>(l * factor);
    SharedMemory::count_conflicts(offsets, static_cast<std::size_t>(width));
    return counts.bank_conflicts;
  };
  CHECK(conflicts(4, 4) == 0);
  CHECK(conflicts(0, 4) == 0);  // one word for all
  CHECK(conflicts(8, 4) == 1);  // two words of every second bank
  CHECK(conflicts(128, 4) == 31);
  CHECK(conflicts(8, 8) == 0);    // two transactions without
  CHECK(conflicts(16, 16) == 0);  // four of eight lanes
  CHECK(conflicts(32, 16) == 4);  // each of which has two words in a bank
}

TEST_CASE("fragments of products are those of plain sums") {
  Lanes a[4], b[2], sum[4], to[4];
  const auto byte = [](const Lanes* of, int r, int l, int i) { return static_cast<std::int8_t>(of[r][l] >> 8 * i); };
  for (int l = 0; l < kWarp; ++l) {
    for (int r = 0; r < 4; ++r)
      a[r][l] = static_cast<std::uint32_t>((l * 4 + r) * 2654435761U), sum[r][l] = static_cast<std::uint32_t>(r - l);
    for (int r = 0; r < 2; ++r) b[r][l] = static_cast<std::uint32_t>((l * 2 + r) * 2246822519U);
  }
  mma_s8(to, a, b, sum);
  // PTX ISA 9.0: row = l / 4 for registers 0 and 2 of a, 8 below for 1 and 3; the depth is (l % 4) * 4 + i, 16 more for
  // 2 and 3. b: the depth (l % 4) * 4 + i, 16 more for 1; column l / 4. sum: row l / 4, 8 below for 2 and 3; column (l
  // % 4) * 2.
  for (int row = 0; row < 16; ++row)
    for (int column = 0; column < 8; ++column) {
      int expected = 0;
      for (int k = 0; k < 32; ++k)
        expected += byte(a, (row >= 8 ? 1 : 0) + (k >= 16 ? 2 : 0), row % 8 * 4 + k % 16 / 4, k % 4) *
                    byte(b, k >= 16 ? 1 : 0, column * 4 + k % 16 / 4, k % 4);
      const int lane = row % 8 * 4 + column / 2, c = (row >= 8 ? 2 : 0) + column % 2;
      REQUIRE(static_cast<int>(to[c][lane]) == expected + static_cast<int>(sum[c][lane]));
    }
}

}  // namespace machine_test
