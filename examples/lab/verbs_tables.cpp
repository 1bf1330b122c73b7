// Tables and data of charts, made of the lines that eval --json prints.
#include <cstdio>
#include <memory>

#include "examples/lab/tables.h"
#include "examples/lab/verbs_lab.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

struct TableOptions {
  Words files, configurations;  // the latter NAME=FILE
  Words scores = {
      "psnr", "ssim", "flip",    "precision", "recall", "shell_recall", "furniture_recall",
      "f1",   "iou",  "outside", "leak",      "ece",    "seconds"};
  std::string method = "completed", csv, reliability;
};

void writeText(const std::string& path, const std::string& text) {
  if (!path.empty()) writeFile("tables", path, text.data(), text.size());
}

void cookTables(const TableOptions& o) {
  std::vector<ResultLine> lines;
  for (const std::string& file : o.files)
    for (const ResultLine& line : readResults(file)) lines.push_back(line);
  writeText(o.csv, methodCsv(lines));
  writeText(o.reliability, reliabilityCsv(lines));
  std::printf("%s", methodTables(lines, o.scores).c_str());
}

void cookCompare(const TableOptions& o) {
  std::vector<NamedResults> all;
  for (const std::string& configuration : o.configurations) {
    const size_t equals = configuration.find('=');
    if (equals == std::string::npos)
      throw UsageError(joinText("compare: ", configuration, ": expected NAME=FILE"));
    all.push_back({configuration.substr(0, equals), readResults(configuration.substr(equals + 1))});
  }
  writeText(o.csv, comparisonCsv(all, o.method));
  std::printf("%s", comparisonTable(all, o.method, o.scores).c_str());
}

Option scoresOption(TableOptions* o) {
  return option("--scores NAME...", &o->scores, "the table's columns");
}
Option csvOption(TableOptions* o) {
  return option("--csv FILE", &o->csv, "to write, with all scores");
}

}  // namespace

Verb tablesVerb() {
  const auto o = std::make_shared<TableOptions>();
  return {"tables",
          "Markdown tables of results: a row a method, mean +- deviation over the scenes",
          "docs/results/rooms_reconstruct.jsonl --scores input_psnr other_psnr",
          {{"",
            {option("FILE...", &o->files, "results, as eval --json prints them"),
             scoresOption(o.get()), csvOption(o.get()),
             option("--reliability FILE", &o->reliability,
                    "CSV to write: how often generated nodes are there, by their probability")}}},
          [o](const Run&, Progress&) { cookTables(*o); }};
}

Verb compareVerb() {
  const auto o = std::make_shared<TableOptions>();
  return {"compare",
          "a Markdown table of configurations, each beside the first one",
          "before=before.jsonl after=after.jsonl",
          {{"",
            {option("NAME=FILE...", &o->configurations,
                    "the configurations' results, as eval --json prints them"),
             option("--method NAME", &o->method, "whose results; \"\": all lines"),
             scoresOption(o.get()), csvOption(o.get())}}},
          [o](const Run&, Progress&) { cookCompare(*o); }};
}

}  // namespace vdbc
