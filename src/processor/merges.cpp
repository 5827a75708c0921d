// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include "processor/merges.h"

#include <algorithm>
#include <queue>
#include <tuple>

namespace vla {
namespace {

/// A part of the word during merging: a node of a linked list in an array.
struct Symbol {
  std::int32_t id;
  int prev, next;  // -1 at the ends
  bool merged_away;
};

struct Candidate {
  std::int32_t rank;
  int left;  // position of the left symbol
  std::int32_t id;

  bool operator<(const Candidate& other) const {  // the queue's top is the lowest rank, leftmost first
    return rank != other.rank ? rank > other.rank : left > other.left;
  }
};

}  // namespace

Result<TokenIds> index_tokens(const std::vector<std::string>& tokens) {
  TokenIds ids;
  ids.reserve(tokens.size());
  for (std::size_t i = 0; i < tokens.size(); ++i) {
    const auto [other, fresh] = ids.emplace(tokens[i], static_cast<std::int32_t>(i));
    if (fresh && !tokens[i].empty()) continue;
    const std::string where = "tokenizer.tokens[" + std::to_string(i) + "]";
    if (tokens[i].empty()) return Error{Code::bad_bundle, where, "a token", "an empty string"};
    return Error{Code::bad_bundle, where, "one id per token", "the text of token " + std::to_string(other->second)};
  }
  return ids;
}

Result<Merges> Merges::create(const TokenIds& ids, const std::vector<std::string>& merges) {
  struct Row {
    std::int32_t left;
    Merge merge;
  };
  std::vector<Row> rows;
  rows.reserve(merges.size());
  std::string whole;
  for (std::size_t rank = 0; rank < merges.size(); ++rank) {
    const std::string where = "tokenizer.merges[" + std::to_string(rank) + "]";
    const std::string_view merge = merges[rank];
    const std::size_t blank = merge.find(' ');
    if (blank == std::string_view::npos || merge.find(' ', blank + 1) != std::string_view::npos)
      return Error{Code::bad_bundle, where, "two tokens and one blank", "text of another form"};
    whole.assign(merge.substr(0, blank)).append(merge.substr(blank + 1));
    const auto left = ids.find(merge.substr(0, blank)), right = ids.find(merge.substr(blank + 1)),
               both = ids.find(whole);
    if (left == ids.end() || right == ids.end() || both == ids.end())
      return Error{Code::bad_bundle, where, "two tokens that make a third", "a part or result without an id"};
    rows.push_back({left->second, {right->second, static_cast<std::int32_t>(rank), both->second}});
  }
  std::sort(rows.begin(), rows.end(), [](const Row& a, const Row& b) {
    return std::tie(a.left, a.merge.right, a.merge.rank) < std::tie(b.left, b.merge.right, b.merge.rank);
  });

  Merges table;
  table.rows_.assign(ids.size() + 1, 0);
  for (std::size_t i = 0; i < rows.size(); ++i) {
    // If a pair is merged twice in the list, the later entry counts, as in the reference.
    const bool again =
        i + 1 < rows.size() && rows[i + 1].left == rows[i].left && rows[i + 1].merge.right == rows[i].merge.right;
    if (again) continue;
    table.merges_.push_back(rows[i].merge);
    ++table.rows_[static_cast<std::size_t>(rows[i].left) + 1];
  }
  for (std::size_t i = 1; i < table.rows_.size(); ++i) table.rows_[i] += table.rows_[i - 1];
  return table;
}

const Merges::Merge* Merges::find(std::int32_t left, std::int32_t right) const {
  const auto row = static_cast<std::size_t>(left);
  const Merge *begin = merges_.data() + rows_[row], *end = merges_.data() + rows_[row + 1];
  const Merge* found =
      std::lower_bound(begin, end, right, [](const Merge& merge, std::int32_t id) { return merge.right < id; });
  return found != end && found->right == right ? found : nullptr;
}

void Merges::apply(const std::vector<std::int32_t>& word, std::vector<std::int32_t>& ids) const {
  const int n = static_cast<int>(word.size());
  std::vector<Symbol> symbols(word.size());
  const auto at = [&](int i) -> Symbol& { return symbols[static_cast<std::size_t>(i)]; };
  for (int i = 0; i < n; ++i) at(i) = {word[static_cast<std::size_t>(i)], i - 1, i + 1 < n ? i + 1 : -1, false};

  std::vector<Candidate> storage;
  storage.reserve(word.size());
  std::priority_queue queue(std::less<Candidate>{}, std::move(storage));
  const auto consider = [&](int left) {
    if (left < 0 || at(left).next < 0) return;
    if (const Merge* merge = find(at(left).id, at(at(left).next).id)) queue.push({merge->rank, left, merge->id});
  };
  for (int i = 0; i < n; ++i) consider(i);

  while (!queue.empty()) {
    const Candidate top = queue.top();
    queue.pop();
    Symbol& left = at(top.left);
    if (left.merged_away || left.next < 0) continue;
    Symbol& right = at(left.next);
    // The pair may have changed since it was queued. As in the reference, it is merged if the result is still the same
    // token.
    const Merge* merge = find(left.id, right.id);
    if (merge == nullptr || merge->id != top.id) continue;
    right.merged_away = true;
    left.id = top.id;
    left.next = right.next;
    if (left.next >= 0) at(left.next).prev = top.left;
    consider(left.prev);
    consider(top.left);
  }
  for (int i = 0; i >= 0 && i < n; i = at(i).next) ids.push_back(at(i).id);
}

}  // namespace vla
