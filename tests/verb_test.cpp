// Verbs as data: what is read, what is said of it, and that every page says the same.
#include "houdini_style_tools/verb.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "examples/lab/verbs_lab.h"
#include "houdini_style_tools/checkpoint.h"
#include "houdini_style_tools/options.h"
#include "houdini_style_tools/verbs.h"

namespace vdbc {
namespace {

// Every kind of option once.
struct Settings {
  std::string views, output, kind = "soft";
  float tau = .2f;
  double margin = 1.5;
  int64_t steps = 4000;
  uint64_t seed = 7;
  bool preview = false;
  std::optional<bool> antialias;
  std::vector<int> frames;
  std::vector<uint64_t> seeds;
  std::vector<double> up, taus;
  std::vector<int> size{224};
  Words changes, files, scores = {"psnr"};
};

Program programOf(Settings* s) {
  const auto nothing = [](const Run&, Progress&) {};
  Program p{"toy", "A toy.", {}};
  p.verbs.push_back(
      {"",
       "does the main thing",
       "room -o x.vdb",
       {{"",
         {option("VIEWS", &s->views, "views"),
          option("-o,--output X.vdb", &s->output, "to write").required(),
          ranges("--frames LIST", &s->frames, "which").otherwise("all"),
          option("--tau P", &s->tau, "kept above").between(0, 1)}},
        {"More",
         {option("--margin METRES", &s->margin, "room around"),
          option("--steps N", &s->steps, "how many").between(1, 10000),
          option("--number N", &s->seed, "a large one"),
          option("--kind NAME", &s->kind, "which kind").oneOf({"soft", "hard"}),
          option("--up X Y Z", &s->up, "what points up"),
          option("--taus P...", &s->taus, "several"),
          option("--size WIDTH [HEIGHT]", &s->size, "in pixels"),
          option("--set NAME=VALUE", &s->changes, "changes"),
          ranges("--seeds LIST", &s->seeds, "which rooms"),
          flag("--antialias", &s->antialias, true, "on"),
          flag("--no-antialias", &s->antialias, false, "off").excludes({"--antialias"}),
          flag("--preview", &s->preview, "too").needs({"--size"})}}},
       nothing});
  p.verbs.push_back({"train", "trains", "", {}, nothing});
  p.verbs.push_back({"train mar", "trains one", "", {}, nothing});
  p.verbs.push_back({"tables",
                     "tables of files",
                     "a b",
                     {{"",
                       {option("FILE...", &s->files, "several"),
                        option("--scores NAME...", &s->scores, "columns")}}},
                     nothing});
  return p;
}

Run parsed(const Program& p, const Words& words) {
  Run run;
  parse(p, *findVerb(p, words), words, &run);
  return run;
}

TEST(Verb, EveryKindOfOptionIsRead) {
  Settings s;
  const vdbc::Run run = parsed(
      programOf(&s), {"-o",        "x.vdb",   "room",      "--tau=.5", "--margin",
                      "-1.5e1",    "--steps", "12",        "--number", "18446744073709551615",
                      "--kind",    "hard",    "--up",      "0",        "-1",
                      "-.5",       "--taus",  ".1",        ".2",       "--size",
                      "64",        "48",      "--set",     "a=1",      "--set=b=2",
                      "--seeds",   "3,10-12", "--frames",  "0,3,5-7",  "--no-antialias",
                      "--preview", "--json",  "--threads", "3"});
  EXPECT_EQ(s.views, "room");
  EXPECT_EQ(s.output, "x.vdb");
  EXPECT_EQ(s.tau, .5f);
  EXPECT_EQ(s.margin, -15);
  EXPECT_EQ(s.steps, 12);
  EXPECT_EQ(s.seed, UINT64_MAX);
  EXPECT_EQ(s.kind, "hard");
  EXPECT_EQ(s.up, (std::vector<double>{0, -1, -.5}));
  EXPECT_EQ(s.taus, (std::vector<double>{.1, .2}));
  EXPECT_EQ(s.size, (std::vector<int>{64, 48}));
  EXPECT_EQ(s.changes, (Words{"a=1", "b=2"}));
  EXPECT_EQ(s.seeds, (std::vector<uint64_t>{3, 10, 11, 12}));
  EXPECT_EQ(s.frames, (std::vector<int>{0, 3, 5, 6, 7}));
  EXPECT_EQ(s.antialias, false);
  EXPECT_TRUE(s.preview);
  EXPECT_TRUE(run.json);
  EXPECT_EQ(run.threads, 3);
  EXPECT_TRUE(run.isGiven("--output"));
  EXPECT_FALSE(run.isGiven("--seed"));
}

TEST(Verb, AnArgumentMayTakeSeveralWords) {
  Settings s;
  parsed(programOf(&s), {"tables", "a", "b", "--scores", "f1", "iou"});
  EXPECT_EQ(s.files, (Words{"a", "b"}));
  EXPECT_EQ(s.scores, (Words{"f1", "iou"})) << "instead of the default";
  EXPECT_THROW(parsed(programOf(&s), {"tables", "--scores", "f1"}), UsageError);
}

TEST(Verb, WhatIsNotGivenStaysAsItWas) {
  Settings s;
  parsed(programOf(&s), {"room", "-o", "x.vdb"});
  EXPECT_EQ(s.tau, .2f);
  EXPECT_EQ(s.margin, 1.5);
  EXPECT_EQ(s.size, (std::vector<int>{224}));
  EXPECT_FALSE(s.antialias);
  EXPECT_TRUE(s.frames.empty());
}

TEST(Verb, BadCommandsNameWhatIsWrong) {
  const std::vector<std::pair<Words, std::string>> bad = {
      {{}, "VIEWS"},
      {{"room"}, "--output"},
      {{"room", "-o", "x", "more"}, "more"},
      {{"room", "-o", "x", "--nothing"}, "--nothing"},
      {{"room", "-o", "x", "--tau"}, "--tau"},
      {{"room", "-o", "x", "--tau", "--preview"}, "--tau"},
      {{"room", "-o", "x", "--tau", "1.5"}, "--tau"},
      {{"room", "-o", "x", "--tau", "nan"}, "--tau"},
      {{"room", "-o", "x", "--tau", ".5x"}, "--tau"},
      {{"room", "-o", "x", "--tau", ""}, "--tau"},
      {{"room", "-o", "x", "--tau", ".5", "--tau", ".5"}, "--tau"},
      {{"room", "-o", "x", "--margin", "nan"}, "--margin"},
      {{"room", "-o", "x", "--steps", "0"}, "--steps"},
      {{"room", "-o", "x", "--steps", "1.5"}, "--steps"},
      {{"room", "-o", "x", "--number", "-1"}, "--number"},
      {{"room", "-o", "x", "--number", "18446744073709551616"}, "--number"},
      {{"room", "-o", "x", "--kind", "none"}, "soft or hard"},
      {{"room", "-o", "x", "--up", "0", "0"}, "--up"},
      {{"room", "-o", "x", "--size"}, "--size"},
      {{"room", "-o", "x", "--preview"}, "--size"},
      {{"room", "-o", "x", "--preview=1", "--size", "9"}, "--preview"},
      {{"room", "-o", "x", "--antialias", "--no-antialias"}, "--no-antialias"},
      {{"room", "-o", "x", "--frames", "4294967296"}, "--frames"},
      {{"train", "none"}, "none"}};
  for (const auto& [words, named] : bad) {
    SCOPED_TRACE(testing::PrintToString(words));
    Settings s;
    try {
      parsed(programOf(&s), words);
      FAIL() << "expected a UsageError";
    } catch (const UsageError& e) {
      EXPECT_NE(std::string(e.what()).find(named), std::string::npos) << e.what();
    }
  }
}

TEST(Verb, TheLongestNameIsMeant) {
  Settings s;
  Program p = programOf(&s);
  EXPECT_EQ(findVerb(p, {"train", "mar", "--json"})->name, "train mar");
  EXPECT_EQ(findVerb(p, {"train", "encoder"})->name, "train");
  EXPECT_EQ(findVerb(p, {"room", "train"})->name, "");
  EXPECT_EQ(findVerb(p, {})->name, "");
  p.verbs.erase(p.verbs.begin());
  EXPECT_EQ(findVerb(p, {"room"}), nullptr);
}

TEST(Verb, TheEnvironmentSpeaksWhereTheCommandDoesNot) {
  Settings s;
  const char* before = std::getenv("VDB_COMPLETE_THREADS");
  const std::string kept = before ? before : "";
  setenv("VDB_COMPLETE_THREADS", "5", 1);
  EXPECT_EQ(parsed(programOf(&s), {"room", "-o", "x"}).threads, 5);
  EXPECT_EQ(parsed(programOf(&s), {"room", "-o", "x", "--threads", "2"}).threads, 2);
  setenv("VDB_COMPLETE_THREADS", "many", 1);
  EXPECT_THROW(parsed(programOf(&s), {"room", "-o", "x"}), UsageError);
  before ? setenv("VDB_COMPLETE_THREADS", kept.c_str(), 1) : unsetenv("VDB_COMPLETE_THREADS");
}

TEST(Verb, ErrorsOfLibrariesAreSaidInOptions) {
  const Verb verb = completeVerb();
  EXPECT_EQ(inOptions(verb, "hole_tau: expected less"), "--hole-tau: expected less");
  EXPECT_EQ(inOptions(verb, "output: x: expected y"), "--output: x: expected y");
  EXPECT_EQ(inOptions(verb, "render: expected less"), "render: expected less");
  EXPECT_EQ(inOptions(verb, "tau"), "--tau");
  EXPECT_EQ(inOptions(verb, ""), "");
}

TEST(NumberRanges, AreReadInTheirOrder) {
  EXPECT_EQ(numberRanges("0,3,5-9"), (std::vector<uint64_t>{0, 3, 5, 6, 7, 8, 9}));
  EXPECT_EQ(numberRanges("7,7,2-2"), (std::vector<uint64_t>{7, 7, 2}));
  EXPECT_EQ(numberRanges("18446744073709551614-18446744073709551615"),
            (std::vector<uint64_t>{UINT64_MAX - 1, UINT64_MAX}));
  EXPECT_EQ(numberRanges("1-100000").size(), 100000u);
}

TEST(NumberRanges, RefuseEverythingElse) {
  for (const char* text :
       {"", ",", "1,", ",1", "3-", "-3", "2-1", "0,,1", "0;1", " 1", "1 ", "1.5", "+1", "one",
        "0-100000", "1-60000,1-60000", "0-18446744073709551615", "18446744073709551616"})
    EXPECT_THROW(numberRanges(text), UsageError) << text;
}

// ---- what is said of the verbs

std::vector<Program> programs() { return {vdbComplete(), vdbLab()}; }

std::string readText(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), std::istreambuf_iterator<char>()};
}

TEST(Verbs, ExamplesAreCommandsThatTheProgramsTake) {
  for (const Program& p : programs())
    for (const Verb& verb : p.verbs) {
      std::stringstream text(verb.name + " " + verb.example);
      Words words;
      for (std::string word; text >> word;) words.push_back(word);
      EXPECT_EQ(findVerb(p, words), &verb);
      EXPECT_NO_THROW(parsed(p, words)) << p.name << " " << verb.name << " " << verb.example;
    }
}

TEST(Verbs, HelpSaysEverythingAndTheCommonFirst) {
  for (const Program& p : programs())
    for (const Verb& verb : p.verbs) {
      const std::string help = helpText(p, verb);
      SCOPED_TRACE(help);
      EXPECT_NE(help.find(verb.does), std::string::npos);
      EXPECT_NE(help.find("example: " + p.name), std::string::npos);
      size_t at = 0;  // groups follow each other as they are listed
      for (const OptionGroup& group : verb.groups) {
        const std::string heading = group.heading.empty() ? "Options" : group.heading;
        EXPECT_EQ(group.heading.empty(), &group == &verb.groups[0]) << "only the common have none";
        at = help.find("\n" + heading + "\n", at);
        ASSERT_NE(at, std::string::npos) << heading;
        for (const Option& o : group.options) {
          EXPECT_FALSE(o.help.empty());
          at = help.find("\n  " + o.names[0], at);
          ASSERT_NE(at, std::string::npos) << o.name();
        }
      }
      for (const char* every : {"--seed", "--threads", "--json", "--help"})
        EXPECT_NE(help.find(every, at), std::string::npos) << every;
    }
}

TEST(Verbs, HelpShowsTheDefaultsOfTheSettings) {
  const Program p = vdbComplete();
  const std::string help = helpText(p, p.verbs[0]);
  EXPECT_NE(help.find(joinText("[", CompleteSettings().tau, "]")), std::string::npos);
  EXPECT_NE(help.find(joinText("[", VolumeSettings().margin_m, "]")), std::string::npos);
}

TEST(Verbs, NoTwoOptionsOfAVerbHaveOneName) {
  for (const Program& p : programs())
    for (const Verb& verb : p.verbs) {
      std::set<std::string> names = {"-h", "--help", "--seed", "--threads", "--json"};
      for (const OptionGroup& group : verb.groups)
        for (const Option& o : group.options)
          for (const std::string& name : o.names)
            EXPECT_TRUE(names.insert(name).second) << verb.name << " " << name;
    }
}

TEST(Verbs, TheReferenceIsUpToDate) {
  for (const Program& p : programs()) {
    const std::string page = p.name == "vdb_lab" ? "docs/lab.md" : "docs/reference.md";
    EXPECT_TRUE(readText(VDBC_SOURCE_DIR "/" + page) == referencePage(p))
        << "make it anew: build/release/" << p.name << " --reference > " << page;
  }
}

TEST(Verbs, TheReadmeHasTheirTable) {
  const std::string readme = readText(VDBC_SOURCE_DIR "/README.md");
  EXPECT_NE(readme.find("<!-- verbs -->\n" + verbTable(vdbComplete()) + "<!-- /verbs -->\n"),
            std::string::npos)
      << "put the table that docs/reference.md begins with between README.md's <!-- verbs --> and "
         "<!-- /verbs -->";
}

// ---- the identity of a completion

std::set<std::string> namesOf(const std::vector<Option>& options) {
  std::set<std::string> names;
  for (const Option& o : options) names.insert(o.name());
  return names;
}

// A new option belongs to growthOptions(), and so to the identity, or here.
TEST(Identity, HasEveryOptionButThoseThatChangeNoGrowth) {
  const std::set<std::string> others = {
      "VIEWS",       "--output",       "--frames",  "--bounds",
      "--up",        "--scale",        "--margin",                // the start
      "--detail",    "--detail-voxel", "--splats",                // what was seen
      "--region",    "--lock",                                    // their content
      "--weights",                                                // the networks' hashes
      "--child-tau", "--antialias",    "--samples", "--resume"};  // after, or around, the growth
  CompleteSettings settings;
  std::set<std::string> expected = namesOf(identityOptions(&settings));
  EXPECT_EQ(expected.erase("--seed"), 1u);  // of every verb
  expected.insert(others.begin(), others.end());
  std::set<std::string> found;
  const Verb verb = completeVerb();
  for (const OptionGroup& group : verb.groups) found.merge(namesOf(group.options));
  EXPECT_EQ(found, expected);
}

TEST(Identity, EveryOptionChangesIt) {
  const std::string weights = VDBC_SOURCE_DIR "/weights/indoor/completer.safetensors";
  if (!std::filesystem::exists(weights)) GTEST_SKIP() << "no trained weights";
  const Completer completer(weights);
  const Place start;
  CompleteSettings settings;
  std::set<std::string> identities = {completionIdentity(completer, start, settings)};
  for (const Option& o : identityOptions(&settings)) {
    const CompleteSettings before = settings;
    o.set(o, o.most == 0 ? Words{} : Words{o.text() == "1" ? "2" : "1"});
    EXPECT_TRUE(identities.insert(completionIdentity(completer, start, settings)).second)
        << o.name();
    settings = before;
  }
  settings.region = std::make_shared<TokenMask>();
  EXPECT_TRUE(identities.insert(completionIdentity(completer, start, settings)).second);
}

TEST(Identity, SaysWhereInTheWorldThePlaceIs) {  // tokens count from the volume's own corner
  const std::string weights = VDBC_SOURCE_DIR "/weights/indoor/completer.safetensors";
  if (!std::filesystem::exists(weights)) GTEST_SKIP() << "no trained weights";
  const Completer completer(weights);
  Place here, there;
  there.frame.world_from_grid.translation().x() = 1;
  EXPECT_NE(completionIdentity(completer, here, {}), completionIdentity(completer, there, {}));
}

}  // namespace
}  // namespace vdbc
