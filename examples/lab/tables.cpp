#include "examples/lab/tables.h"

#include <algorithm>
#include <cmath>
#include <nlohmann/json.hpp>
#include <set>
#include <sstream>

#include "examples/lab/scores.h"
#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

using Lines = std::vector<const ResultLine*>;

// How tables show a score.
struct TableColumn {
  std::string score, head;
  int digits;
};

TableColumn columnOf(const std::string& score) {
  static const std::vector<TableColumn> known = {{"psnr", "PSNR", 2},
                                                 {"ssim", "SSIM", 3},
                                                 {"flip", "FLIP", 3},
                                                 {"shell_recall", "of the shell", 3},
                                                 {"f1", "F1", 3},
                                                 {"furniture_recall", "of furniture", 3},
                                                 {"iou", "IoU", 3},
                                                 {"outside", "outside", 0},
                                                 {"ece", "ECE", 3},
                                                 {"seconds", "s", 2},
                                                 {"lpips", "LPIPS", 3},
                                                 {"peak_rss_mb", "peak MB", 0},
                                                 {"gaussians", "Gaussians", 0}};
  for (const TableColumn& c : known)
    if (c.score == score) return c;
  return {score, score, 3};
}

std::string fixed(double value, int digits, const char* format = "%.*f") {
  char text[64];
  std::snprintf(text, sizeof text, format, digits, value);
  return text;
}

std::string kindOf(const ResultLine& line) { return line.scene.substr(0, line.scene.find(':')); }

std::vector<double> valuesOf(const Lines& lines, const std::string& score) {
  std::vector<double> values;
  for (const ResultLine* line : lines)
    if (const auto found = line->scores.find(score); found != line->scores.end())
      values.push_back(found->second);
  return values;
}

// The lines in groups of one key, in the order in which the keys appear.
template <typename Key>
auto grouped(const Lines& lines, const Key& key) {
  std::vector<std::pair<decltype(key(*lines[0])), Lines>> groups;
  for (const ResultLine* line : lines) {
    const auto k = key(*line);
    auto group = std::find_if(groups.begin(), groups.end(), [&](auto& g) { return g.first == k; });
    if (group == groups.end()) group = groups.insert(groups.end(), {k, {}});
    group->second.push_back(line);
  }
  return groups;
}

template <typename Accept>
Lines chosen(const std::vector<ResultLine>& lines, const Accept& accept) {
  Lines result;
  for (const ResultLine& line : lines)
    if (accept(line)) result.push_back(&line);
  return result;
}

bool hasScores(const ResultLine& line) { return line.reliability.empty(); }

Lines ofMethod(const NamedResults& configuration, const std::string& method) {
  const Lines lines = chosen(configuration.lines, [&](const ResultLine& line) {
    return hasScores(line) && (method.empty() || line.method == method);
  });
  require(!lines.empty(), "compare: ", configuration.name, ": expected results of ",
          method.empty() ? "any method" : method, ", found none");
  return lines;
}

std::string rowOf(const std::vector<std::string>& cells) {
  std::string row = "|";
  for (const std::string& cell : cells) row += " " + cell + " |";
  return row + "\n";
}

std::string headOf(const std::vector<std::string>& cells) {
  std::string rule = "|";
  for (size_t i = 0; i < cells.size(); ++i) rule += "---|";
  return rowOf(cells) + rule + "\n";
}

std::string csvRow(const std::vector<std::string>& cells) {
  std::string row;
  for (std::string cell : cells) {
    if (cell.find_first_of(",\"\n") != std::string::npos) {
      for (size_t i = 0; (i = cell.find('"', i)) != std::string::npos; i += 2)
        cell.insert(i, 1, '"');
      cell = '"' + cell + '"';
    }
    row += cell + ',';
  }
  row.back() = '\n';
  return row;
}

// Rows with some labels and the means and deviations of all scores of their lines.
std::string summaryCsv(std::vector<std::string> labels,
                       const std::vector<std::pair<std::vector<std::string>, Lines>>& rows) {
  std::set<std::string> scores;
  for (const auto& [cells, lines] : rows)
    for (const ResultLine* line : lines)
      for (const auto& [score, value] : line->scores) scores.insert(score);
  labels.push_back("scenes");
  for (const std::string& score : scores)
    labels.insert(labels.end(), {score, score + "_deviation"});
  std::string csv = csvRow(labels);
  for (auto [cells, lines] : rows) {
    cells.push_back(std::to_string(lines.size()));
    for (const std::string& score : scores) {
      const std::vector<double> values = valuesOf(lines, score);
      for (double number : {meanOf(values), deviationOf(values)})
        cells.push_back(std::isfinite(number) ? fixed(number, 6, "%.*g") : "");
    }
    csv += csvRow(cells);
  }
  return csv;
}

// By kind of scene and method, then with more and more views.
template <typename Add>
void forEachCurvePoint(const Lines& lines, const Add& add) {
  const auto curve = [](const ResultLine& l) { return std::make_pair(kindOf(l), l.method); };
  for (auto& [key, all] : grouped(lines, curve)) {
    auto points = grouped(all, [](const ResultLine& l) { return l.views; });
    std::sort(points.begin(), points.end(),
              [](const auto& a, const auto& b) { return a.first < b.first; });
    for (const auto& [views, point] : points)
      add(std::vector<std::string>{key.first, key.second, std::to_string(views)}, point);
  }
}

// Mean of the differences over the scenes that both have, and its standard error.
std::string differenceTo(const Lines& base, const Lines& lines, const TableColumn& column) {
  std::vector<double> differences;
  for (const ResultLine* line : lines)
    for (const ResultLine* other : base) {
      const auto a = line->scores.find(column.score), b = other->scores.find(column.score);
      if (line->scene == other->scene && line->views == other->views && a != line->scores.end() &&
          b != other->scores.end())
        differences.push_back(a->second - b->second);
    }
  if (differences.empty()) return "";
  const double error = deviationOf(differences) / std::sqrt(double(differences.size()));
  return fixed(meanOf(differences), column.digits, "%+.*f") +
         (std::isfinite(error) ? " (" + fixed(error, column.digits) + ")" : "");
}

ResultLine parseLine(const nlohmann::json& j) {
  ResultLine line;
  line.scene = j.value("scene", ""), line.method = j.value("method", ""),
  line.views = j.value("views", int64_t(0));
  if (j.contains("reliability"))
    line.reliability = j["reliability"].get<std::vector<std::array<double, 3>>>();
  for (const auto& [name, value] : j.items())
    if (value.is_number() && name != "views") line.scores[name] = value.get<double>();
  return line;
}

}  // namespace

std::vector<ResultLine> readResults(const std::string& path) {
  const std::vector<uint8_t> bytes = readFile("results", path, uint64_t(1) << 30);
  std::istringstream in(std::string(bytes.begin(), bytes.end()));
  std::vector<ResultLine> lines;
  size_t number = 0;
  for (std::string text; std::getline(in, text);) {
    ++number;
    try {
      const ResultLine line = parseLine(nlohmann::json::parse(text));
      if (line.scene != "mean" && line.scene != "std") lines.push_back(line);
    } catch (const nlohmann::json::exception& e) {
      throw Error(joinText("results: ", path, ": line ", number,
                           ": expected results in JSON: ", firstLine(e)));
    }
  }
  return lines;
}

std::string methodTables(const std::vector<ResultLine>& lines,
                         const std::vector<std::string>& scores) {
  const Lines shown = chosen(lines, [](const ResultLine& line) {
    return hasScores(line) && line.method.rfind("completed-tau-", 0) != 0;
  });
  std::string text;
  const auto table = [](const ResultLine& l) { return std::make_pair(kindOf(l), l.views); };
  for (const auto& [key, all] : grouped(shown, table)) {
    std::set<std::string> scenes;
    for (const ResultLine* line : all) scenes.insert(line->scene);
    text += joinText(text.empty() ? "" : "\n", scenes.size(), " ", key.first, ", ", key.second,
                     key.second == 1 ? " view" : " views", " in:\n\n");
    std::vector<std::string> head = {"method"};
    for (const std::string& score : scores) head.push_back(columnOf(score).head);
    text += headOf(head);
    for (const auto& [method, rows] : grouped(all, [](const ResultLine& l) { return l.method; })) {
      std::vector<std::string> cells = {method};
      for (const std::string& score : scores) {
        const int digits = columnOf(score).digits;
        const std::vector<double> values = valuesOf(rows, score);
        const double deviation = deviationOf(values);
        cells.push_back(values.empty() ? "" : fixed(meanOf(values), digits));
        if (std::isfinite(deviation)) cells.back() += " +- " + fixed(deviation, digits);
      }
      text += rowOf(cells);
    }
  }
  return text;
}

std::string methodCsv(const std::vector<ResultLine>& lines) {
  std::vector<std::pair<std::vector<std::string>, Lines>> rows;
  forEachCurvePoint(chosen(lines, hasScores), [&](const auto& labels, const Lines& point) {
    rows.push_back({labels, point});
  });
  return summaryCsv({"kind", "method", "views"}, rows);
}

std::string reliabilityCsv(const std::vector<ResultLine>& lines) {
  std::string csv = csvRow({"kind", "method", "views", "probability", "share", "nodes"});
  const Lines calibrated = chosen(lines, [](const ResultLine& line) { return !hasScores(line); });
  forEachCurvePoint(calibrated, [&](const auto& labels, const Lines& point) {
    size_t bins = point[0]->reliability.size();
    for (const ResultLine* line : point) bins = std::min(bins, line->reliability.size());
    for (size_t bin = 0; bin < bins; ++bin) {
      std::array<double, 3> sum{};
      for (const ResultLine* line : point)
        for (size_t i = 0; i < 3; ++i) sum[i] += line->reliability[bin][i];
      if (sum[0] <= 0) continue;
      std::vector<std::string> cells = labels;
      for (double number : {sum[1] / sum[0], sum[2] / sum[0]})
        cells.push_back(fixed(number, 6, "%.*g"));
      cells.push_back(fixed(sum[0], 0));
      csv += csvRow(cells);
    }
  });
  return csv;
}

std::string comparisonTable(const std::vector<NamedResults>& configurations,
                            const std::string& method, const std::vector<std::string>& scores) {
  std::vector<std::string> head = {""};
  std::vector<TableColumn> compared;
  for (const std::string& score : scores) head.push_back(columnOf(score).head);
  for (const char* score : {"f1", "psnr"})
    if (std::find(scores.begin(), scores.end(), score) != scores.end()) {
      compared.push_back(columnOf(score));
      head.push_back(compared.back().head + " to " + configurations.at(0).name);
    }
  std::string text = headOf(head);
  const Lines base = ofMethod(configurations.at(0), method);
  for (const NamedResults& configuration : configurations) {
    const Lines lines = ofMethod(configuration, method);
    std::vector<std::string> cells = {configuration.name};
    for (const std::string& score : scores) {
      const std::vector<double> values = valuesOf(lines, score);
      cells.push_back(values.empty() ? "" : fixed(meanOf(values), columnOf(score).digits));
    }
    for (const TableColumn& column : compared) cells.push_back(differenceTo(base, lines, column));
    text += rowOf(cells);
  }
  return text;
}

std::string comparisonCsv(const std::vector<NamedResults>& configurations,
                          const std::string& method) {
  std::vector<std::pair<std::vector<std::string>, Lines>> rows;
  for (const NamedResults& configuration : configurations)
    rows.push_back({{configuration.name}, ofMethod(configuration, method)});
  return summaryCsv({"configuration"}, rows);
}

}  // namespace vdbc
