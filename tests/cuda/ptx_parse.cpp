// SPDX-FileCopyrightText: The vla.cpp authors
// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <set>
#include <sstream>
#include <string_view>
#include <unordered_map>

#include "cuda/fault.h"
#include "cuda/ptx.h"

namespace vla::test::cuda {
namespace {

constexpr std::size_t kMaskSize = 4;

bool starts_with(std::string_view text, std::string_view with) { return text.substr(0, with.size()) == with; }

std::vector<std::string> split(const std::string& text, char at) {
  std::vector<std::string> parts;
  std::istringstream in(text);
  for (std::string part; std::getline(in, part, at);) parts.push_back(part);
  return parts;
}
std::vector<std::string> words(const std::string& text) {
  std::vector<std::string> all;
  std::istringstream in(text);
  for (std::string word; in >> word;) all.push_back(word);
  return all;
}
/// A number in brackets behind a name, as in `name[16]`, or 0.
std::size_t in_brackets(const std::string& text) {
  const std::size_t open = text.find('[');
  return open == std::string::npos ? 0 : std::strtoull(text.c_str() + open + 1, nullptr, 10);
}
std::string before_bracket(const std::string& word) { return word.substr(0, word.find('[')); }

/// Reads one kernel, a statement at a time.
class Reader {
 public:
  explicit Reader(PtxKernel& kernel, const std::map<std::string, std::size_t>& shared)
      : kernel_(kernel), shared_(shared) {}

  void statement(const std::string& text) {
    const std::vector<std::string> parts = words(text);
    if (parts.empty()) return;
    const std::string& first = parts[0];
    if (first == ".reg") return declare(parts);
    if (first == ".shared") return declare_shared(before_bracket(parts.back()), in_brackets(parts.back()));
    if (first == ".pragma") return;
    if (first[0] == '.') throw Fault("unknown directive " + first);
    instruction(text);
  }
  void label(const std::string& name) { labels_[name] = static_cast<int>(kernel_.code.size()); }
  void param(const std::string& name, std::size_t size) { params_[name] = size; }

  void finish() {
    for (auto& [instruction, label] : jumps_) {
      const auto found = labels_.find(label);
      if (found == labels_.end()) throw Fault("no label " + label);
      kernel_.code[instruction].target = found->second;
    }
    // Constants come first, so that a warp begins with a copy of them.
    std::size_t size = 0;
    for (const Constant& constant : constants_) size += constant.width * kWarp;
    kernel_.constants.resize(size);
    std::size_t at = 0;
    for (const Constant& constant : constants_)
      for (int l = 0; l < kWarp; ++l, at += constant.width)
        std::memcpy(&kernel_.constants[at], &constant.value, constant.width);
    const auto shift = [&](std::uint32_t place) {
      return place & kConstant ? constant_places_[place & ~kConstant] : place + static_cast<std::uint32_t>(size);
    };
    for (PtxInstruction& one : kernel_.code) {
      for (int i = 0; i < one.n_operand; ++i) one.operand[i] = shift(one.operand[i]);
      for (auto* places : {&one.sums, &one.of_a})
        for (std::uint32_t& place : *places) place = shift(place);
      if (one.has_guard) one.guard = shift(one.guard);
    }
    std::set<std::uint32_t> operands;
    for (const PtxInstruction& one : kernel_.code) operands.insert(one.of_a.begin(), one.of_a.end());
    for (PtxInstruction& one : kernel_.code)
      one.makes_operand = one.kind == PtxInstruction::kPlain && one.n_operand > 0 && operands.contains(one.operand[0]);
    for (PtxKernel::Special& special : kernel_.specials) special.place = shift(special.place);
    for (PtxKernel::SharedAddress& address : kernel_.dynamic_shared) address.place = shift(address.place);
    kernel_.register_bytes = size + n_byte_;
  }

 private:
  struct Constant {
    std::uint64_t value;
    std::size_t width;
  };
  struct Register {
    std::uint32_t place;
    char type;
  };
  static constexpr std::uint32_t kConstant = 1U << 31;

  /// .reg .b32 %r<10>; or .reg .pred p, q;
  void declare(const std::vector<std::string>& parts) {
    const std::string& type = parts[1];
    const char kind = type == ".pred" ? 'p' : type.find("64") != std::string::npos ? 'q' : 'd';
    if (type == ".f64" || type.find("128") != std::string::npos) throw Fault("registers of type " + type);
    for (std::size_t i = 2; i < parts.size(); ++i)
      for (const std::string& name : split(parts[i], ',')) {
        const std::size_t open = name.find('<');
        if (open == std::string::npos) {
          add_register(name, kind);
          continue;
        }
        const int n = std::atoi(name.c_str() + open + 1);
        for (int k = 0; k < n; ++k) add_register(name.substr(0, open) + std::to_string(k), kind);
      }
  }
  Register add_register(const std::string& name, char type) {
    const Register one = {n_byte_, type};
    n_byte_ += static_cast<std::uint32_t>(type == 'p' ? kMaskSize : (type == 'q' ? 8 : 4) * kWarp);
    n_byte_ = (n_byte_ + 31) / 32 * 32;
    registers_[name] = one;
    return one;
  }
  void declare_shared(const std::string& name, std::size_t size) {
    kernel_.static_shared = (kernel_.static_shared + 15) / 16 * 16;
    own_shared_[name] = kernel_.static_shared;
    kernel_.static_shared += size;
  }

  std::uint32_t constant(std::uint64_t value, char type) {
    if (type == 'p') return constant(value == 0 ? 0 : 0xffffffff, 'd');  // the mask of all lanes
    const std::size_t width = type == 'q' ? 8 : 4;
    for (std::size_t i = 0; i < constants_.size(); ++i)
      if (constants_[i].value == value && constants_[i].width == width)
        return kConstant | static_cast<std::uint32_t>(i);
    const std::size_t at =
        constants_.empty() ? std::size_t{0} : constant_places_.back() + constants_.back().width * kWarp;
    constants_.push_back({value, width}), constant_places_.push_back(static_cast<std::uint32_t>(at));
    return kConstant | static_cast<std::uint32_t>(constants_.size() - 1);
  }

  /// The register or constant that `word` names, of the type that the operation wants.
  std::uint32_t operand(const std::string& word, char type) {
    if (const auto found = registers_.find(word); found != registers_.end()) {
      if (found->second.type != type) throw Fault(word + " is no register of the operation's type");
      return found->second.place;
    }
    for (int i = 0; i < static_cast<int>(std::size(kSpecials)); ++i)
      if (word == kSpecials[i]) {
        const Register one = add_register(word, 'd');
        kernel_.specials.push_back({one.place, i});
        return operand(word, type);
      }
    if (word[0] == '%') throw Fault("unknown register " + word);
    if (starts_with(word, "0f") || starts_with(word, "0F"))
      return constant(std::strtoull(word.c_str() + 2, nullptr, 16), type);
    if (word[0] == '-' || (word[0] >= '0' && word[0] <= '9')) {
      const auto value = static_cast<std::uint64_t>(std::strtoll(word.c_str(), nullptr, 0));
      return constant(type == 'q' ? value : value & 0xffffffff, type);
    }
    if (const auto found = own_shared_.find(word); found != own_shared_.end()) return constant(found->second, type);
    if (const auto found = params_.find(word); found != params_.end()) return constant(found->second, type);
    if (const auto found = shared_.find(word); found != shared_.end()) {
      if (found->second != 0) {
        declare_shared(word, found->second);
        return operand(word, type);
      }
      kernel_.dynamic_shared.push_back({add_register(word, type).place, type == 'q'});
      return registers_[word].place;
    }
    throw Fault("unknown name " + word);
  }

  void instruction(std::string text) {
    PtxInstruction one;
    one.text = text;
    if (text[0] == '@') {
      const std::size_t end = text.find_first_of(" \t"), name = text[1] == '!' ? 2 : 1;
      one.has_guard = true, one.guard_is_not = name == 2;
      one.guard = operand(text.substr(name, end - name), 'p');
      text = text.substr(text.find_first_not_of(" \t", end));
    }
    const std::string name = text.substr(0, text.find_first_of(" \t"));
    std::string rest = text.substr(name.size());
    std::vector<std::string> operands;
    std::string word;
    for (char c : rest + ",") {  // braces of vectors say nothing that the operation does not
      if (c == ',' || c == '|') {
        if (!word.empty()) operands.push_back(word);
        word.clear();
      } else if (!std::strchr(" \t{}", c)) {
        word += c;
      }
    }
    try {
      decode(one, name, operands);
    } catch (const Fault& problem) {
      throw Fault(std::string(problem.what()) + " in: " + one.text);
    }
    kernel_.code.push_back(std::move(one));
  }

  /// [name+offset]: the address's register, and the offset.
  void address(PtxInstruction& one, const std::string& word, int which) {
    std::string inside = word.substr(1, word.find(']') - 1);
    const std::size_t plus = inside.find('+');
    if (plus != std::string::npos) one.offset[which] = std::strtoll(inside.c_str() + plus + 1, nullptr, 0);
    inside = inside.substr(0, plus);
    const auto found = registers_.find(inside);
    const char type = found == registers_.end() ? 'd' : found->second.type;
    one.operand[one.n_operand++] = operand(inside, type);
    wide_ = type == 'q';
  }

  void decode(PtxInstruction& one, const std::string& name, const std::vector<std::string>& operands) {
    if (name == "bra" || name == "bra.uni") {
      one.kind = PtxInstruction::kBranch;
      jumps_.push_back({kernel_.code.size(), operands.at(0)});
      return;
    }
    if (name == "ret" || name == "exit") {
      one.kind = PtxInstruction::kReturn;
      return;
    }
    if (starts_with(name, "ld.") || starts_with(name, "st.")) return decode_access(one, name, operands);
    if (starts_with(name, "wgmma.mma_async.")) return decode_wgmma(one, name, operands);
    if (starts_with(name, "cp.async.bulk.tensor.")) return decode_box_copy(one, name, operands);
    one.is_move = name == "mov.f32" || name == "mov.b32" || name == "mov.u32";
    const PtxOperation* operation = find_operation(name);
    if (starts_with(name, "cvt.") && operation != nullptr && operation->operands[1] == 'd')
      if (const auto found = registers_.find(operands.at(1)); found != registers_.end() && found->second.type == 'q')
        operation = find_operation(name + " of 64 bits");  // the bits above those that it takes are passed over
    if (operation == nullptr) throw Fault("unknown instruction " + name);
    one.run = operation->run, one.kind = operation->kind;
    const std::string_view types = operation->operands;
    if (operands.size() != types.size()) throw Fault("another number of operands than " + std::string(types));
    int n_address = 0;
    for (std::size_t i = 0; i < types.size(); ++i) {
      if (types[i] == 's' || types[i] == 'g') {  // an address in shared or global memory
        address(one, operands[i], n_address++);
        if (wide_ != (types[i] == 'g')) throw Fault("an address of another width");
      } else if (types[i] == '_') {
        if (operands[i] != "_") throw Fault("a result that is not known");
      } else {
        one.operand[one.n_operand++] = operand(operands[i], types[i]);
      }
    }
  }

  /// Sums, a's descriptor or four registers, b's descriptor, whether it adds; of floats also that nothing is negated,
  /// and whether a and b are transposed, which a in registers cannot be.
  void decode_wgmma(PtxInstruction& one, const std::string& name, const std::vector<std::string>& operands) {
    one.run = find_wgmma(name, one.product), one.kind = PtxInstruction::kWarp;
    if (one.run == nullptr) throw Fault("unknown instruction " + name);
    const auto n_sum = static_cast<std::size_t>(one.product.n / 2);
    const bool is_bf16 = one.product.kind == WgmmaProduct::bf16;
    one.product.a_in_registers = operands.size() == n_sum + (is_bf16 ? 9 : 6);
    std::vector<std::string> tail = {"1", "1", "0"};
    if (!is_bf16 || one.product.a_in_registers) tail.resize(is_bf16 ? 2 : 0);
    const std::size_t n_of_a = one.product.a_in_registers ? 4 : 1, first = n_sum + n_of_a + 2;
    if (operands.size() != first + tail.size() + (is_bf16 ? 1 : 0)) throw Fault("another number of operands");
    if (!std::equal(tail.begin(), tail.end(), operands.begin() + static_cast<std::ptrdiff_t>(first)))
      throw Fault("wgmma that negates, or transposes a");
    if (is_bf16 && operands.back() != "0" && operands.back() != "1") throw Fault("wgmma that transposes otherwise");
    one.product.b_transposed = is_bf16 && operands.back() == "1";
    for (std::size_t i = 0; i < n_sum; ++i) one.sums.push_back(operand(operands[i], 'd'));
    for (std::size_t i = 0; one.product.a_in_registers && i < n_of_a; ++i)
      one.of_a.push_back(operand(operands[n_sum + i], 'd'));
    const std::size_t b = n_sum + n_of_a;
    for (const std::size_t i : {one.product.a_in_registers ? b : n_sum, b})
      one.operand[one.n_operand++] = operand(operands[i], 'q');
    one.operand[one.n_operand++] = operand(operands[b + 1], 'p');
  }

  /// [to], [map, {a place}], [mbarrier] and perhaps the mask of blocks.
  void decode_box_copy(PtxInstruction& one, const std::string& name, const std::vector<std::string>& operands) {
    bool has_mask = false;
    one.run = find_box_copy(name, one.count, has_mask);
    if (one.run == nullptr) throw Fault("unknown instruction " + name);
    if (operands.size() != static_cast<std::size_t>(one.count) + (has_mask ? 4U : 3U))
      throw Fault("another number of operands");
    for (std::size_t i = 0; i < operands.size(); ++i) {
      std::string word = operands[i];
      std::erase_if(word, [](char c) { return c == '[' || c == ']'; });
      one.operand[one.n_operand++] = operand(word, i == 1 ? 'q' : 'd');
    }
  }

  void decode_access(PtxInstruction& one, const std::string& name, std::vector<std::string> operands) {
    const std::vector<std::string> parts = split(name, '.');
    std::size_t i = 2;
    if (i < parts.size() && parts[i] == "nc") ++i;
    if (i < parts.size() && (parts[i] == "v2" || parts[i] == "v4")) one.count = parts[i++][1] - '0';
    if (i + 1 != parts.size()) throw Fault("unknown instruction " + name);
    const std::string& type = parts[i];
    one.width = std::atoi(type.c_str() + 1) / 8, one.sign = type[0] == 's';
    one.run = find_access(parts[0], parts[1]);
    if (one.run == nullptr || !std::strchr("subf", type[0]) || one.width < 1 || one.width > 8)
      throw Fault("unknown instruction " + name);
    const std::size_t at = parts[0] == "ld" ? operands.size() - 1 : 0;
    if (operands.size() != static_cast<std::size_t>(one.count) + 1) throw Fault("another number of operands");
    address(one, operands[at], 0);
    if (parts[1] != "param" && wide_ != (parts[1] == "global")) throw Fault("an address of another width");
    one.wide_address = wide_;
    operands.erase(operands.begin() + static_cast<std::ptrdiff_t>(at));
    for (const std::string& word : operands) {
      const auto found = registers_.find(word);
      one.wide_value = one.width == 8 || (found != registers_.end() && found->second.type == 'q');
      one.operand[one.n_operand++] = operand(word, one.wide_value ? 'q' : 'd');
    }
  }

  PtxKernel& kernel_;
  const std::map<std::string, std::size_t>& shared_;  // of the module: name and size, 0 where the launch tells
  std::unordered_map<std::string, Register> registers_;
  std::unordered_map<std::string, std::size_t> own_shared_, params_;
  std::unordered_map<std::string, int> labels_;
  std::vector<std::pair<std::size_t, std::string>> jumps_;
  std::vector<Constant> constants_;
  std::vector<std::uint32_t> constant_places_;
  std::uint32_t n_byte_ = 0;
  bool wide_ = false;  // the last address
};

std::string without_comments(const std::string& text) {
  std::string out;
  for (const std::string& line : split(text, '\n')) out += line.substr(0, line.find("//")) + "\n";
  return out;
}

}  // namespace

PtxModule::PtxModule(const std::string& text) {
  std::map<std::string, std::size_t> shared;
  const bool overlaps = text.find(".target sm_90") != std::string::npos;  // as the driver launches it
  std::unique_ptr<Reader> reader;
  PtxKernel* kernel = nullptr;
  std::string statement;
  bool in_head = false;
  int depth = 0;  // braces inside of a kernel
  const auto report = [&](const Fault& problem) {
    return Fault("PTX of " + (kernel ? kernel->name : "a module") + ": " + problem.what());
  };
  const auto trim = [](std::string s) {
    const std::size_t first = s.find_first_not_of(" \t\n"), last = s.find_last_not_of(" \t\n");
    return first == std::string::npos ? std::string() : s.substr(first, last - first + 1);
  };
  try {
    for (char c : without_comments(text)) {
      if (c == '{' && in_head) {  // .visible .entry name( .param ..., ... ) .maxntid 128, 1, 1
        in_head = false;
        const std::size_t open = statement.find('('), close = statement.find(')');
        const std::string name = words(statement.substr(0, open)).back();
        kernel = &kernels_[name];
        kernel->name = name, kernel->overlaps = overlaps;
        reader = std::make_unique<Reader>(*kernel, shared);
        for (const std::string& param : split(statement.substr(open + 1, close - open - 1), ',')) {
          const std::vector<std::string> parts = words(param);
          if (parts.size() < 3) continue;
          if (kernel->param_size != 0) throw Fault("more than one parameter");
          reader->param(before_bracket(parts.back()), 0);
          kernel->param_size = std::max<std::size_t>(in_brackets(parts.back()), 8);
        }
        if (const std::size_t at = statement.find(".maxntid"); at != std::string::npos)
          kernel->max_thread = std::atoi(statement.c_str() + at + 8);
        statement.clear();
      } else if (c == '{' && reader && trim(statement).empty()) {  // names inside hide those outside
        ++depth;
      } else if (c == '}' && depth > 0 && trim(statement).empty()) {
        --depth;
      } else if (c == '}' && kernel != nullptr && trim(statement).empty()) {
        reader->finish();
        reader.reset(), kernel = nullptr, statement.clear();
      } else if (c == ';') {
        const std::string whole = trim(statement);
        statement.clear();
        if (reader) {
          reader->statement(whole);
        } else if (const std::vector<std::string> parts = words(whole); parts.size() > 1) {
          const bool is_shared = std::find(parts.begin(), parts.end(), ".shared") != parts.end();
          if (!is_shared) throw Fault("unknown declaration: " + whole);
          shared[before_bracket(parts.back())] = in_brackets(parts.back());
        }
      } else if (c == ':' && reader && trim(statement)[0] == '$') {
        reader->label(trim(statement));
        statement.clear();
      } else {
        statement += c;
        if (c == '\n' && !reader && !in_head) {
          const std::string line = trim(statement);
          if (starts_with(line, ".version") || starts_with(line, ".target") || starts_with(line, ".address_size"))
            statement.clear();
        }
        if (c == '(' && !reader && statement.find(".entry") != std::string::npos) in_head = true;
      }
    }
  } catch (const Fault& problem) {
    throw report(problem);
  }
  if (kernel != nullptr) throw Fault("PTX of " + kernel->name + ": ends in the middle");
}

const PtxKernel* PtxModule::find(const std::string& name) const {
  const auto found = kernels_.find(name);
  return found == kernels_.end() ? nullptr : &found->second;
}

}  // namespace vla::test::cuda
