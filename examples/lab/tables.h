#pragma once
// Tables and data of charts, made of results as `--json` prints them.
#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <vector>

namespace vdbc {

/// A line of results: what a method reached on a scene, or the reliability of its probabilities
/// there.
struct ResultLine {
  std::string scene, method;
  int64_t views = 0;
  std::map<std::string, double> scores;            // all numbers of the line but null
  std::vector<std::array<double, 3>> reliability;  // a bin: count, sum of probabilities, hits
};
/// All lines of a file but those that sum up its scenes. Throws Error naming the line.
std::vector<ResultLine> readResults(const std::string& path);

/// The results of one configuration.
struct NamedResults {
  std::string name;
  std::vector<ResultLine> lines;
};

/// Markdown: for each kind of scene (`rooms` of rooms:1) and number of views a table with a row a
/// method, mean +- standard deviation over the scenes. Methods completed-tau-T are left out:
/// charts show them.
std::string methodTables(const std::vector<ResultLine>& lines,
                         const std::vector<std::string>& scores);
/// The means and standard deviations of all scores and methods, a row a kind of scene, method and
/// number of views: `X` and `X_deviation`, empty where there is no value.
std::string methodCsv(const std::vector<ResultLine>& lines);
/// A row a kind of scene, method, number of views and bin that holds nodes: mean probability, share
/// in the truth, nodes.
std::string reliabilityCsv(const std::vector<ResultLine>& lines);

/// Markdown: a row a configuration, means of what `method` reached ("": of all lines), and of F1
/// and PSNR, where they are among `scores`, also the mean difference to the first configuration
/// over the scenes that both have, with its standard error.
std::string comparisonTable(const std::vector<NamedResults>& configurations,
                            const std::string& method, const std::vector<std::string>& scores);
/// The same configurations with all of their scores, as methodCsv() has them.
std::string comparisonCsv(const std::vector<NamedResults>& configurations,
                          const std::string& method);

}  // namespace vdbc
