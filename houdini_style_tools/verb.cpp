#include "houdini_style_tools/verb.h"

#include <algorithm>
#include <cctype>
#include <charconv>
#include <cmath>
#include <cstdlib>
#include <sstream>

namespace vdbc {
namespace {

constexpr size_t kMany = std::numeric_limits<size_t>::max();
constexpr uint64_t kMaxNumbers = 100000;

Words split(const std::string& text, char between) {
  Words parts;
  std::stringstream in(text);
  for (std::string part; std::getline(in, part, between);) parts.push_back(part);
  return parts;
}

std::string join(const Words& words, const char* between) {
  std::string text;
  for (const std::string& w : words) text += (text.empty() ? "" : between) + w;
  return text;
}

std::string textOf(const std::string& value) { return value; }
template <typename Number>
std::string textOf(Number value) {  // the shortest text that is read as the same number
  char text[32];
  return {text, std::to_chars(text, text + sizeof text, value).ptr};
}
template <typename Value>
std::string textOf(const std::vector<Value>& values) {
  Words words;
  for (const Value& v : values) words.push_back(textOf(v));
  return join(words, " ");
}

void read(const Option& option, const std::string& word, std::string* value) {
  const Words& these = option.choices;
  if (!these.empty() && std::find(these.begin(), these.end(), word) == these.end())
    throw UsageError(joinText("expected ", join(these, " or "), ", found ", word));
  *value = word;
}

// The whole word, in the option's range.
template <typename Number>
void read(const Option& option, const std::string& word, Number* value) {
  const char* end = word.data() + word.size();
  const auto [stop, error] = std::from_chars(word.data(), end, *value);
  // Not a number is not in range either.
  if (error == std::errc() && stop == end && double(*value) >= option.low &&
      double(*value) <= option.high)
    return;
  const bool bounded = std::isfinite(option.low);
  throw UsageError(
      joinText("expected ", std::is_integral_v<Number> ? "a whole number" : "a number",
               bounded ? joinText(" from ", textOf(option.low), " to ", textOf(option.high)) : "",
               ", found ", word));
}

template <typename Value>
void readAll(const Option& option, const Words& words, Value* value) {
  read(option, words[0], value);
}
template <typename Value>
void readAll(const Option& option, const Words& words, std::vector<Value>* values) {
  if (!option.is_repeatable) values->clear();
  for (const std::string& word : words) read(option, word, &values->emplace_back());
}

// "P...": as many as there are.
bool isMany(const std::string& unit) { return unit.find("...") != std::string::npos; }

// The option whose look is `spec`, bound to nothing.
Option makeOption(const std::string& spec, std::string help) {
  Option o;
  o.help = std::move(help);
  Words parts = split(spec, ' ');
  o.names = split(parts[0], ',');
  if (parts[0][0] != '-') {
    o.is_argument = o.is_required = true;
    o.least = 1, o.most = isMany(parts[0]) ? kMany : 1;
    return o;
  }
  parts.erase(parts.begin());
  for (const std::string& value : parts) {
    o.least += value[0] != '[';
    o.most = isMany(value) ? kMany : o.most + 1;
  }
  o.unit = join(parts, " ");
  return o;
}

template <typename Number>
Option makeRanges(const std::string& spec, std::vector<Number>* field, std::string help) {
  Option o = makeOption(spec, std::move(help));
  o.set = [field](const Option&, const Words& words) {
    field->clear();
    for (uint64_t n : numberRanges(words[0])) {
      if (n > uint64_t(std::numeric_limits<Number>::max()))
        throw UsageError(joinText("expected smaller numbers, found ", n));
      field->push_back(Number(n));
    }
  };
  o.text = [field] { return textOf(*field); };
  return o;
}

// "-x" and "--xyz", not "-1.5", "-.5" or "-".
bool looksLikeOption(const std::string& word) {
  return word.size() > 1 && word[0] == '-' && word[1] != '.' && !(word[1] >= '0' && word[1] <= '9');
}

OptionGroup runOptions(Run* run) {
  return {"Every verb",
          {seedOption(&run->seed),
           option("--threads N", &run->threads, "worker threads; 0: all cores")
               .between(0, 1024)
               .fromEnvironment("VDB_COMPLETE_THREADS"),
           flag("--json", &run->json,
                "results (stdout) and progress (stderr) as JSON, one object a line"),
           flag("-h,--help", nullptr, "this text")}};
}

std::string withUnit(const std::string& names, const Option& o) {
  return names + (o.unit.empty() ? "" : " " + o.unit);
}

// The verb's own name after the program's.
std::string command(const Program& program, const Verb& verb) {
  return program.name + (verb.name.empty() ? "" : " " + verb.name);
}

// "vdb_complete decode LATENTS -o Y.vdb": with what is required.
std::string synopsis(const Program& program, const Verb& verb) {
  std::string text = command(program, verb);
  for (const OptionGroup& group : verb.groups)
    for (const Option& o : group.options)
      if (o.is_required) text += " " + withUnit(o.names[0], o);
  return text;
}

// Two columns; the right one is wrapped.
std::string row(const std::string& left, const std::string& right) {
  constexpr size_t kIndent = 28, kWidth = 98;
  std::string text = "  " + left;
  text += text.size() + 2 > kIndent ? "\n" + std::string(kIndent, ' ')
                                    : std::string(kIndent - text.size(), ' ');
  size_t column = kIndent;
  for (const std::string& word : split(right, ' ')) {
    if (column > kIndent && column + 1 + word.size() > kWidth) {
      text += "\n" + std::string(kIndent, ' ');
      column = kIndent;
    } else if (column > kIndent) {
      text += " ", ++column;
    }
    text += word, column += word.size();
  }
  return text + "\n";
}

std::string groupHelp(const OptionGroup& group) {
  std::string text = "\n" + (group.heading.empty() ? "Options" : group.heading) + "\n";
  for (const Option& o : group.options) {
    text += row(withUnit(join(o.names, ", "), o),
                o.help + (o.standard.empty() ? "" : " [" + o.standard + "]"));
  }
  return text;
}

std::string exampleOf(const Program& program, const Verb& verb) {
  return command(program, verb) + (verb.example.empty() ? "" : " " + verb.example);
}

std::string verbHelp(const Program& program, const Verb& verb, const std::string& does) {
  return does + "\n\nusage:   " + synopsis(program, verb) +
         " [options]\nexample: " + exampleOf(program, verb) + "\n";
}

std::string optionsHelp(const Verb& verb) {
  std::string text;
  for (const OptionGroup& group : verb.groups) text += groupHelp(group);
  Run run;
  return text + groupHelp(runOptions(&run));
}

std::string verbList(const Program& program) {
  std::string text = "\nVerbs (" + program.name + " VERB --help)\n";
  for (const Verb& v : program.verbs)
    if (!v.name.empty()) text += row(v.name, v.does);
  return text;
}

std::string sentence(std::string text) {
  text[0] = char(std::toupper(text[0]));
  return text + ".";
}

std::string optionTable(const OptionGroup& group) {
  std::string text = group.heading.empty() ? "" : "\n" + group.heading + ":\n";
  text += "\n| option | default | what it is |\n|---|---|---|\n";
  for (const Option& o : group.options)
    text += joinText("| `", withUnit(join(o.names, ", "), o), "` | ",
                     o.is_required ? "required" : o.standard, " | ", o.help, " |\n");
  return text;
}

}  // namespace

Option& Option::required() {
  is_required = true;
  standard.clear();
  return *this;
}
Option& Option::between(double lowest, double highest) {
  low = lowest, high = highest;
  return *this;
}
Option& Option::oneOf(Words these) {
  choices = std::move(these);
  return *this;
}
Option& Option::otherwise(std::string text_of_default) {
  standard = std::move(text_of_default);
  return *this;
}
Option& Option::excludes(Words others) {
  excluded = std::move(others);
  return *this;
}
Option& Option::needs(Words others) {
  needed = std::move(others);
  return *this;
}
Option& Option::fromEnvironment(std::string name_of_variable) {
  variable = std::move(name_of_variable);
  standard = variable + ", or else " + standard;
  return *this;
}

template <typename Field>
Option option(const std::string& spec, Field* field, std::string help) {
  Option o = makeOption(spec, std::move(help));
  o.set = [field](const Option& self, const Words& words) { readAll(self, words, field); };
  o.text = [field] { return textOf(*field); };
  o.standard = o.text();
  o.is_repeatable = std::is_same_v<Field, Words> && o.most == 1;
  return o;
}
template Option option(const std::string&, int*, std::string);
template Option option(const std::string&, int64_t*, std::string);
template Option option(const std::string&, uint64_t*, std::string);
template Option option(const std::string&, float*, std::string);
template Option option(const std::string&, double*, std::string);
template Option option(const std::string&, std::string*, std::string);
template Option option(const std::string&, std::vector<int>*, std::string);
template Option option(const std::string&, std::vector<double>*, std::string);
template Option option(const std::string&, Words*, std::string);

Option flag(const std::string& spec, bool* field, std::string help) {
  Option o = makeOption(spec, std::move(help));
  o.set = [field](const Option&, const Words&) { *field = true; };
  o.text = [field] { return *field ? "true" : "false"; };
  return o;
}

Option flag(const std::string& spec, std::optional<bool>* field, bool value, std::string help) {
  Option o = makeOption(spec, std::move(help));
  o.set = [field, value](const Option&, const Words&) { *field = value; };
  o.text = [field, value] { return *field == value ? "true" : "false"; };
  return o;
}

Option ranges(const std::string& spec, std::vector<int>* field, std::string help) {
  return makeRanges(spec, field, std::move(help));
}
Option ranges(const std::string& spec, std::vector<uint64_t>* field, std::string help) {
  return makeRanges(spec, field, std::move(help));
}

std::vector<uint64_t> numberRanges(const std::string& text) {
  std::vector<uint64_t> numbers;
  const char *at = text.data(), *end = at + text.size();
  const auto number = [&](uint64_t* value) {
    const auto [stop, error] = std::from_chars(at, end, *value);
    at = stop;
    return error == std::errc();
  };
  for (;;) {
    uint64_t first = 0;
    bool fine = number(&first);
    uint64_t last = first;
    if (fine && at != end && *at == '-') ++at, fine = number(&last);
    if (!fine || last < first || last - first >= kMaxNumbers - numbers.size()) break;
    for (uint64_t i = 0; i <= last - first; ++i) numbers.push_back(first + i);
    if (at == end) return numbers;
    if (*at++ != ',') break;
  }
  throw UsageError(joinText("expected numbers and ranges such as 0,3,5-9, at most ", kMaxNumbers,
                            " numbers, found ", text));
}

Option seedOption(uint64_t* seed) { return option("--seed N", seed, "fixes every random choice"); }

const Verb* findVerb(const Program& program, const Words& words) {
  const Verb* found = nullptr;
  size_t longest = 0;
  for (const Verb& verb : program.verbs) {
    const Words name = split(verb.name, ' ');
    if (words.size() < name.size() || !std::equal(name.begin(), name.end(), words.begin()))
      continue;
    if (found && name.size() <= longest) continue;
    found = &verb, longest = name.size();
  }
  return found;
}

void parse(const Program& program, const Verb& verb, const Words& words, Run* run) {
  const std::string see = " (" + command(program, verb) + " --help)";
  std::vector<Option> options;
  for (const OptionGroup& group : verb.groups)
    options.insert(options.end(), group.options.begin(), group.options.end());
  for (const Option& o : runOptions(run).options) options.push_back(o);
  const auto set = [](const Option& o, const std::string& name, const Words& values) {
    try {
      o.set(o, values);
    } catch (const UsageError& e) {
      throw UsageError(joinText(name, ": ", e.what()));
    }
  };
  size_t at = split(verb.name, ' ').size();
  while (at < words.size()) {
    std::string name = words[at++];
    Words values;
    const bool named = looksLikeOption(name);
    const size_t equals = named ? name.find('=') : std::string::npos;
    if (!named) values = {name};
    if (equals != std::string::npos) values = {name.substr(equals + 1)}, name.resize(equals);
    const auto o = std::find_if(options.begin(), options.end(), [&](const Option& candidate) {
      if (!named) return candidate.is_argument && !run->isGiven(candidate.name());
      return !candidate.is_argument &&
             std::count(candidate.names.begin(), candidate.names.end(), name) > 0;
    });
    if (o == options.end()) throw UsageError(joinText(name, ": not expected", see));
    if (equals == std::string::npos)
      while (values.size() < o->most && at < words.size() && !looksLikeOption(words[at]))
        values.push_back(words[at++]);
    if (values.size() < o->least || values.size() > o->most)
      throw UsageError(joinText(o->name(), ": expected ", o->unit.empty() ? "no value" : o->unit,
                                ", found ", values.empty() ? "nothing" : join(values, " "), see));
    if (!run->given.insert(o->name()).second && !o->is_repeatable)
      throw UsageError(joinText(o->name(), ": expected once", see));
    set(*o, o->name(), values);
  }
  for (const Option& o : options) {
    const char* value = o.variable.empty() ? nullptr : std::getenv(o.variable.c_str());
    if (value && !run->isGiven(o.name())) set(o, o.variable, {value});
    if (o.is_required && !run->isGiven(o.name()))
      throw UsageError(joinText(o.name(), ": expected ", synopsis(program, verb),
                                verb.name.empty() ? ", or a verb" : "", see));
    if (!run->isGiven(o.name())) continue;
    for (const std::string& other : o.excluded)
      if (run->isGiven(other)) throw UsageError(joinText(o.name(), ": not with ", other, see));
    for (const std::string& other : o.needed)
      if (!run->isGiven(other)) throw UsageError(joinText(o.name(), ": needs ", other, see));
  }
}

std::string inOptions(const Verb& verb, const std::string& message) {
  std::string name = "--" + message.substr(0, message.find(':'));
  std::replace(name.begin(), name.end(), '_', '-');
  for (const OptionGroup& group : verb.groups)
    for (const Option& o : group.options)
      if (o.name() == name) return name + message.substr(name.size() - 2);
  return message;
}

std::string helpText(const Program& program, const Verb& verb) {
  return verbHelp(program, verb, command(program, verb) + ": " + verb.does) + optionsHelp(verb);
}

std::string frontPage(const Program& program) {
  const Verb* main_job = findVerb(program, {});
  if (!main_job) return program.does + "\n" + verbList(program);
  return verbHelp(program, *main_job, program.does) + verbList(program) + optionsHelp(*main_job);
}

std::string verbTable(const Program& program) {
  std::string text = "| command | what it does |\n|---|---|\n";
  for (const Verb& v : program.verbs)
    text += joinText("| `", synopsis(program, v), "` | ", v.does, " |\n");
  return text;
}

std::string referencePage(const Program& program) {
  std::string text = joinText("<!-- Made by `", program.name, " --reference`. -->\n# ",
                              program.name, "\n\n", program.does, "\n\n", verbTable(program));
  for (const Verb& v : program.verbs) {
    text += joinText("\n## ", command(program, v), "\n\n", sentence(v.does), "\n\n```sh\n",
                     exampleOf(program, v), "\n```\n");
    for (const OptionGroup& group : v.groups) text += optionTable(group);
  }
  Run run;
  const OptionGroup every = runOptions(&run);
  return text + "\n## " + every.heading + "\n" + optionTable({"", every.options});
}

}  // namespace vdbc
