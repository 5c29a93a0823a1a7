// SPDX-License-Identifier: MIT
#include "ajna/loss/expression.hpp"

#include <torch/csrc/jit/runtime/graph_executor.h>
#include <torch/jit.h>

#include <algorithm>
#include <cctype>
#include <cmath>
#include <iomanip>
#include <locale>
#include <map>
#include <memory>
#include <sstream>

#include "ajna/base/error.hpp"

namespace ajna::loss {
namespace {

struct Function {
  std::size_t arguments;
  const char* before;  // TorchScript around the comma-separated arguments
  const char* after;
};

const std::map<std::string, Function>& functions() {
  static const std::map<std::string, Function> table = {
      {"abs", {1, "torch.abs(", ")"}},
      {"acos", {1, "torch.acos(", ")"}},
      {"asin", {1, "torch.asin(", ")"}},
      {"atan", {1, "torch.atan(", ")"}},
      {"clamp", {3, "torch.clamp(", ")"}},
      {"cos", {1, "torch.cos(", ")"}},
      {"erf", {1, "torch.erf(", ")"}},
      {"exp", {1, "torch.exp(", ")"}},
      {"expm1", {1, "torch.expm1(", ")"}},
      {"log", {1, "torch.log(", ")"}},
      {"log1p", {1, "torch.log1p(", ")"}},
      {"maximum", {2, "torch.maximum(", ")"}},
      {"minimum", {2, "torch.minimum(", ")"}},
      {"norm", {1, "torch.linalg_vector_norm(", ", 2, [1], True)"}},
      {"relu", {1, "torch.relu(", ")"}},
      {"sigmoid", {1, "torch.sigmoid(", ")"}},
      {"sin", {1, "torch.sin(", ")"}},
      {"softplus", {1, "torch.softplus(", ")"}},
      {"sqrt", {1, "torch.sqrt(", ")"}},
      {"square", {1, "torch.square(", ")"}},
      {"sum", {1, "torch.sum(", ", [1], True)"}},
      {"tan", {1, "torch.tan(", ")"}},
      {"tanh", {1, "torch.tanh(", ")"}},
  };
  return table;
}

bool starts_name(char c) { return std::isalpha(static_cast<unsigned char>(c)) != 0 || c == '_'; }
bool in_name(char c) { return std::isalnum(static_cast<unsigned char>(c)) != 0 || c == '_'; }
bool is_digit(char c) { return std::isdigit(static_cast<unsigned char>(c)) != 0; }

/// Recursive descent over the text; what it returns is TorchScript, fully parenthesised.
class Parser {
 public:
  Parser(const std::string& what, const std::string& text, const std::vector<std::string>& arguments,
         const TermParams& constants)
      : what_(what), text_(text), arguments_(arguments), constants_(constants) {}

  std::string parse() {
    const auto result = sum();
    if (!at_end()) {
      fail("unexpected '" + std::string(1, text_[at_]) + "'");
    }
    for (const auto& argument : arguments_) {
      if (std::find(used_.begin(), used_.end(), argument) == used_.end()) {
        throw_invalid(what_ + " = '" + text_ + "' does not use its argument '" + argument + "': write a function of " +
                      joined(arguments_));
      }
    }
    return result.text;
  }

 private:
  /// A piece of TorchScript; `value` where it is a plain number rather than a tensor.
  struct Piece {
    std::string text;
    bool number = false;
    double value = 0.0;
  };

  [[noreturn]] void fail(const std::string& fault) const {
    throw_invalid(what_ + " = '" + text_ + "': " + fault + " at column " + std::to_string(at_ + 1) +
                  ": write numbers, " + joined(arguments_) + ", + - * / **, parentheses and functions such as log(a)");
  }

  static std::string joined(const std::vector<std::string>& names) {
    std::string result;
    for (std::size_t i = 0; i < names.size(); ++i) {
      result += (i == 0 ? "" : " and ") + names[i];
    }
    return result;
  }

  bool at_end() {
    while (at_ < text_.size() && std::isspace(static_cast<unsigned char>(text_[at_])) != 0) {
      ++at_;
    }
    return at_ == text_.size();
  }

  bool accept(const std::string& token) {
    if (at_end() || text_.compare(at_, token.size(), token) != 0) return false;
    if (token == "*" && text_.compare(at_, 2, "**") == 0) return false;
    at_ += token.size();
    return true;
  }

  void expect(const std::string& token) {
    if (!accept(token)) {
      fail("missing '" + token + "'");
    }
  }

  Piece combine(const Piece& left, const std::string& sign, const Piece& right) const {
    if (!left.number || !right.number) return {"(" + left.text + " " + sign + " " + right.text + ")"};
    const double x = left.value, y = right.value;
    const double value = sign == "+"   ? x + y
                         : sign == "-" ? x - y
                         : sign == "*" ? x * y
                         : sign == "/" ? x / y
                                       : std::pow(x, y);
    if (!std::isfinite(value)) {
      fail("a constant that is not finite before");
    }
    return literal(value);
  }

  Piece sum() {
    // The grammar recurses: a limit keeps a hostile config from exhausting the stack.
    if (++depth_ > 100) {
      fail("more than 100 nested parentheses");
    }
    auto result = product();
    for (;;) {
      if (accept("+")) {
        result = combine(result, "+", product());
      } else if (accept("-")) {
        result = combine(result, "-", product());
      } else {
        --depth_;
        return result;
      }
    }
  }

  Piece product() {
    auto result = signed_factor();
    for (;;) {
      if (accept("*")) {
        result = combine(result, "*", signed_factor());
      } else if (accept("/")) {
        result = combine(result, "/", signed_factor());
      } else {
        return result;
      }
    }
  }

  Piece signed_factor() {
    bool negative = false;
    for (;;) {
      if (accept("-")) {
        negative = !negative;
      } else if (!accept("+")) {
        break;
      }
    }
    auto value = power();
    if (!negative) return value;
    return value.number ? literal(-value.value) : Piece{"(-" + value.text + ")"};
  }

  Piece power() {
    auto base = atom();
    if (!accept("**")) return base;
    if (++depth_ > 100) {
      fail("more than 100 nested powers");
    }
    auto result = combine(base, "**", signed_factor());
    --depth_;
    return result;
  }

  Piece atom() {
    if (at_end()) {
      fail("the expression ends too early");
    }
    if (accept("(")) {
      auto inside = sum();
      expect(")");
      return inside;
    }
    if (is_digit(text_[at_]) || text_[at_] == '.') return number();
    if (starts_name(text_[at_])) return name();
    fail("unexpected '" + std::string(1, text_[at_]) + "'");
  }

  static Piece literal(double value) {
    std::ostringstream text;
    text.imbue(std::locale::classic());
    text << '(' << std::scientific << std::setprecision(17) << value << ')';  // always a float: 1 / 2 is 0.5, not 0
    return {text.str(), true, value};
  }

  Piece number() {
    std::size_t end = at_;
    const auto digits = [&] {
      const auto begin = end;
      while (end < text_.size() && is_digit(text_[end])) ++end;
      return end - begin;
    };
    std::size_t count = digits();
    if (end < text_.size() && text_[end] == '.') {
      ++end;
      count += digits();
    }
    if (count == 0) {
      fail("unexpected '.'");
    }
    if (end < text_.size() && (text_[end] == 'e' || text_[end] == 'E')) {
      ++end;
      if (end < text_.size() && (text_[end] == '+' || text_[end] == '-')) ++end;
      if (digits() == 0) {
        fail("a number without digits in its exponent");
      }
    }
    std::istringstream stream(text_.substr(at_, end - at_));
    stream.imbue(std::locale::classic());
    double value = 0.0;
    stream >> value;
    if (stream.fail() || !std::isfinite(value)) {
      fail("the number '" + text_.substr(at_, end - at_) + "' is out of range");
    }
    if (end < text_.size() && in_name(text_[end])) {
      fail("missing operator after '" + text_.substr(at_, end - at_) + "'");
    }
    at_ = end;
    return literal(value);
  }

  Piece name() {
    std::size_t end = at_;
    while (end < text_.size() && in_name(text_[end])) ++end;
    const auto word = text_.substr(at_, end - at_);
    const auto begin = at_;
    at_ = end;
    if (accept("(")) {
      const auto found = functions().find(word);
      if (found == functions().end()) {
        at_ = begin;
        unknown("function", word, expression_functions());
      }
      if ((word == "norm" || word == "sum") && arguments_.size() == 1) {
        fail(word + " works over the channel axis, which only f has,");
      }
      return call(word, found->second);
    }
    at_ = end;
    if (std::find(arguments_.begin(), arguments_.end(), word) != arguments_.end()) {
      used_.push_back(word);
      return {word};
    }
    if (const auto found = constants_.find(word); found != constants_.end()) return literal(found->second);
    at_ = begin;
    if (functions().count(word) != 0) {
      at_ = end;
      fail("missing '(' after the function '" + word + "'");
    }
    auto known = arguments_;
    for (const auto& [constant, value] : constants_) {
      known.push_back(constant);
    }
    unknown("name", word, known);
  }

  [[noreturn]] void unknown(const std::string& kind, const std::string& word,
                            const std::vector<std::string>& known) const {
    throw_unknown(kind + " at column " + std::to_string(at_ + 1) + " of " + what_ + " = '" + text_ + "'", word, known);
  }

  Piece call(const std::string& name, const Function& function) {
    std::string inside;
    std::size_t count = 0;
    do {
      auto argument = sum();
      // Functions take tensors; the bounds of clamp stay numbers.
      const bool bound = name == "clamp" && count > 0;
      if (bound && !argument.number) {
        fail("the bounds of clamp must be numbers");
      }
      if (argument.number && !bound) {
        argument.text = "torch.full_like(" + arguments_.front() + ", " + argument.text + ")";
      }
      inside += (count++ == 0 ? "" : ", ") + argument.text;
    } while (accept(","));
    expect(")");
    if (count != function.arguments) {
      fail(name + " takes " + std::to_string(function.arguments) + " arguments, not " + std::to_string(count) + ",");
    }
    return {function.before + inside + function.after};
  }

  const std::string& what_;
  const std::string& text_;
  const std::vector<std::string>& arguments_;
  const TermParams& constants_;
  std::vector<std::string> used_;
  std::size_t at_ = 0;
  int depth_ = 0;
};

}  // namespace

Expression::Expression(const std::string& what, std::string text, std::vector<std::string> arguments,
                       const TermParams& constants)
    : text_(std::move(text)) {
  for (const auto& [name, value] : constants) {
    const bool taken = std::find(arguments.begin(), arguments.end(), name) != arguments.end() ||
                       functions().count(name) != 0 || name.empty() || !starts_name(name[0]);
    if (taken || !std::isfinite(value)) {
      throw_invalid("parameter '" + name + "' of " + what + " = '" + text_ + "' " +
                    (taken ? "cannot be used as a name: choose another" : "is not finite: give a number"));
    }
  }
  const auto body = Parser(what, text_, arguments, constants).parse();
  std::string signature;
  for (const auto& argument : arguments) {
    signature += (signature.empty() ? "" : ", ") + argument + ": Tensor";
  }
  source_ = "def term(" + signature + ") -> Tensor:\n    return " + body + "\n";
  std::shared_ptr<torch::jit::CompilationUnit> unit;
  try {
    unit = torch::jit::compile(source_);
  } catch (const std::exception& error) {
    std::istringstream lines(error.what());
    std::string first;
    while (first.empty() && std::getline(lines, first)) {
    }
    throw_invalid(what + " = '" + text_ + "' does not compile (" + first + "): change the expression");
  }
  run_ = [unit, graph = &unit->get_function("term")](const std::vector<torch::Tensor>& values) {
    // Op by op: the profiling executor would specialise and fuse, which costs seconds and buys nothing here.
    const torch::jit::GraphOptimizerEnabledGuard plain(false);
    return (*graph)(std::vector<c10::IValue>(values.begin(), values.end())).toTensor();
  };
}

torch::Tensor Expression::operator()(const std::vector<torch::Tensor>& values) const { return run_(values); }

bool is_expression(const std::string& name, const std::vector<std::string>& arguments) {
  const bool is_name = !name.empty() && starts_name(name[0]) && std::all_of(name.begin(), name.end(), in_name);
  return !is_name || std::find(arguments.begin(), arguments.end(), name) != arguments.end();
}

std::vector<std::string> expression_functions() {
  std::vector<std::string> names;
  for (const auto& [name, function] : functions()) {
    names.push_back(name);
  }
  return names;
}

}  // namespace ajna::loss
