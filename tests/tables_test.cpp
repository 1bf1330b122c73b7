#include "examples/lab/tables.h"

#include <gtest/gtest.h>

#include "tests/files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

ResultLine line(const std::string& scene, const std::string& method, int64_t views,
                std::map<std::string, double> scores) {
  return {scene, method, views, std::move(scores), {}};
}

TEST(Tables, ResultsAreReadWithoutWhatSumsThemUp) {
  const TemporaryFolder folder;
  const std::string file = folder / "results.jsonl";
  writeBytes(file,
             R"({"scene":"rooms:1","views":2,"method":"box","psnr":12.5,"lpips":null})"
             "\n"
             R"({"scene":"rooms:1","views":2,"method":"box","reliability":[[4,1.0,2],[0,0.0,0]]})"
             "\n"
             R"({"scene":"mean","views":2,"method":"box","psnr":12.5})"
             "\n"
             R"({"scene":"std","views":2,"method":"box","psnr":null})"
             "\n");
  const std::vector<ResultLine> lines = readResults(file);
  ASSERT_EQ(lines.size(), 2u);
  EXPECT_EQ(lines[0].scene, "rooms:1");
  EXPECT_EQ(lines[0].method, "box");
  EXPECT_EQ(lines[0].views, 2);
  EXPECT_EQ(lines[0].scores, (std::map<std::string, double>{{"psnr", 12.5}}));
  EXPECT_EQ(lines[1].reliability, (std::vector<std::array<double, 3>>{{4, 1, 2}, {0, 0, 0}}));
}

TEST(Tables, LinesThatAreNoResultsAreNamed) {
  const TemporaryFolder folder;
  const std::string file = folder / "results.jsonl";
  for (const char* bad : {"{\"scene\":", "[1]", R"({"scene":1})", R"({"reliability":[[1,2]]})"}) {
    writeBytes(file, std::string("{}\n") + bad + "\n");
    try {
      readResults(file);
      ADD_FAILURE() << bad;
    } catch (const Error& e) {
      EXPECT_NE(std::string(e.what()).find(file + ": line 2"), std::string::npos) << e.what();
    }
  }
  EXPECT_THROW(readResults(file + ".none"), Error);
}

TEST(Tables, AMethodHasAMeanAndADeviationOverItsScenes) {
  const std::vector<ResultLine> lines = {
      line("rooms:1", "box", 2, {{"psnr", 10}, {"outside", 7}}),
      line("rooms:1", "completed", 2, {{"psnr", 20}}),
      line("rooms:1", "completed-tau-0.5", 2, {{"psnr", 21}}),
      line("rooms:2", "box", 2, {{"psnr", 13}}),
      line("homes:1", "box", 1, {{"psnr", 9}}),
  };
  EXPECT_EQ(methodTables(lines, {"psnr", "outside"}),
            "2 rooms, 2 views in:\n\n"
            "| method | PSNR | outside |\n"
            "|---|---|---|\n"
            "| box | 11.50 +- 2.12 | 7 |\n"
            "| completed | 20.00 |  |\n"
            "\n"
            "1 homes, 1 view in:\n\n"
            "| method | PSNR | outside |\n"
            "|---|---|---|\n"
            "| box | 9.00 |  |\n");
  EXPECT_EQ(methodCsv(lines),
            "kind,method,views,scenes,outside,outside_deviation,psnr,psnr_deviation\n"
            "rooms,box,2,2,7,,11.5,2.12132\n"
            "rooms,completed,2,1,,,20,\n"
            "rooms,completed-tau-0.5,2,1,,,21,\n"
            "homes,box,1,1,,,9,\n");
}

TEST(Tables, CurvesGoWithTheViews) {
  EXPECT_EQ(
      methodCsv({line("rooms:1", "box", 8, {{"psnr", 3}}), line("rooms:1", "box", 1, {{"psnr", 1}}),
                 line("rooms:1", "box", 2, {{"psnr", 2}})}),
      "kind,method,views,scenes,psnr,psnr_deviation\n"
      "rooms,box,1,1,1,\nrooms,box,2,1,2,\nrooms,box,8,1,3,\n");
}

TEST(Tables, ReliabilityIsPooledOverScenes) {
  ResultLine a = line("rooms:1", "completed", 2, {}), b = line("rooms:2", "completed", 2, {});
  a.reliability = {{3, .6, 1}, {0, 0, 0}, {1, .9, 1}};
  b.reliability = {{1, .2, 1}, {0, 0, 0}, {1, .7, 0}};
  EXPECT_EQ(reliabilityCsv({a, b, line("rooms:1", "completed", 2, {{"psnr", 1}})}),
            "kind,method,views,probability,share,nodes\n"
            "rooms,completed,2,0.2,0.5,4\n"
            "rooms,completed,2,0.8,0.5,2\n");
}

TEST(Tables, ConfigurationsAreComparedSceneByScene) {
  const auto run = [](std::string name, double f1_of_1, double f1_of_2) {
    return NamedResults{std::move(name),
                        {line("rooms:2", "completed", 2, {{"f1", f1_of_2}, {"seconds", 2}}),
                         line("rooms:1", "completed", 2, {{"f1", f1_of_1}, {"seconds", 1}}),
                         line("rooms:1", "box", 2, {{"f1", 0}, {"seconds", 9}})}};
  };
  NamedResults other = run("less, much", .75, .5);
  std::swap(other.lines[0], other.lines[1]);
  other.lines.push_back(line("rooms:3", "completed", 2, {{"f1", .625}}));  // the first has no such
  const std::vector<NamedResults> runs = {run("base", .25, .5), other};
  EXPECT_EQ(comparisonTable(runs, "completed", {"f1", "seconds"}),
            "|  | F1 | s | F1 to base |\n"
            "|---|---|---|---|\n"
            "| base | 0.375 | 1.50 | +0.000 (0.000) |\n"
            "| less, much | 0.625 | 1.50 | +0.250 (0.250) |\n");
  EXPECT_EQ(comparisonCsv(runs, "completed"),
            "configuration,scenes,f1,f1_deviation,seconds,seconds_deviation\n"
            "base,2,0.375,0.176777,1.5,0.707107\n"
            "\"less, much\",3,0.625,0.125,1.5,0.707107\n");
  EXPECT_THROW(comparisonTable(runs, "none", {"f1"}), Error);
}

}  // namespace
}  // namespace vdbc
