#pragma once
// Verbs as data: one list makes parsing, --help, the README's table and docs/reference.md.
#include <cstdint>
#include <functional>
#include <limits>
#include <optional>
#include <set>
#include <string>
#include <vector>

#include "vdb/progress.h"

namespace vdbc {

using Words = std::vector<std::string>;

/// One option or argument and the settings field that it sets. Made by option(), ranges() or
/// flag(), from what help shows: "-o,--output X.vdb", "--up X Y Z", "--taus T...",
/// "--size WIDTH [HEIGHT]", or "VIEWS" for an argument without a name before it.
struct Option {
  Words names;       // short ones first; the last one is what messages call it
  std::string unit;  // what its values are; "" for a flag
  std::string help;
  std::string standard;        // what it is unless it is given; "" where there is nothing to say
  size_t least = 0, most = 0;  // values
  bool is_argument = false;    // no name before it; always required
  bool is_required = false;
  bool is_repeatable = false;  // each time it is given adds to what was given before
  double low = -std::numeric_limits<double>::infinity(), high = -low;  // of numbers
  Words choices;                                                       // of texts; empty: anything
  Words excluded, needed;  // names of options that it cannot be, or is only, given with
  std::string variable;    // of the environment, read where the option is not given
  std::function<void(const Option&, const Words&)> set;  // throws UsageError without the name
  std::function<std::string()> text;                     // the field as words

  const std::string& name() const { return names.back(); }

  Option& required();
  Option& between(double low, double high);
  Option& oneOf(Words choices);
  /// What it is unless it is given, where the field's own value does not say it.
  Option& otherwise(std::string standard);
  Option& excludes(Words names);
  Option& needs(Words names);
  Option& fromEnvironment(std::string variable);
};

/// An option whose look is `spec` and that sets `field`, which holds the default. A field is an
/// int, int64_t, uint64_t, float, double or std::string, or a vector of int, double or std::string.
/// Of a vector of texts of which each option has one, the option may come again and adds to it.
template <typename Field>
Option option(const std::string& spec, Field* field, std::string help);

/// An option without a value: given, the field is true, or `value`.
Option flag(const std::string& spec, bool* field, std::string help);
Option flag(const std::string& spec, std::optional<bool>* field, bool value, std::string help);

/// An option of numbers and ranges, numberRanges().
Option ranges(const std::string& spec, std::vector<int>* field, std::string help);
Option ranges(const std::string& spec, std::vector<uint64_t>* field, std::string help);

/// "0,3,5-9" -> 0 3 5 6 7 8 9, in the order given. Throws UsageError for anything else, and for
/// more than 100,000 numbers.
std::vector<uint64_t> numberRanges(const std::string& text);

/// Options under one heading of the help; those that most people need have none and come first.
struct OptionGroup {
  std::string heading;
  std::vector<Option> options;
};

/// What every verb is told, and which options were given.
struct Run {
  uint64_t seed = 1;
  int threads = 0;
  bool json = false;
  std::set<std::string> given;  // by name: "--output"

  bool isGiven(const std::string& name) const { return given.count(name) > 0; }
};

struct Verb {
  std::string name;     // "decode", "train mar"; "": what the program does without a verb
  std::string does;     // in one line
  std::string example;  // a command's arguments, after the verb
  std::vector<OptionGroup> groups;
  std::function<void(const Run&, Progress&)> cook;
};

struct Program {
  std::string name, does;
  std::vector<Verb> verbs;
};

/// The option that fixes every random choice.
Option seedOption(uint64_t* seed);

/// The verb that a command's first words name, or else the one without a name; null: there is none.
const Verb* findVerb(const Program& program, const Words& command);
/// Sets the verb's fields and `run` to what the command says. Throws UsageError.
void parse(const Program& program, const Verb& verb, const Words& command, Run* run);
/// "frames: expected ..." as the user knows it: "--frames: expected ...". Libraries name their
/// settings, after which options are called.
std::string inOptions(const Verb& verb, const std::string& message);

/// For the terminal: of one verb, and of the whole program.
std::string helpText(const Program& program, const Verb& verb);
std::string frontPage(const Program& program);
/// Markdown: a table of the verbs, and the page with every option, which begins with that table.
std::string verbTable(const Program& program);
std::string referencePage(const Program& program);

}  // namespace vdbc
