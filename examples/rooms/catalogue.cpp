#include "examples/rooms/catalogue.h"

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstring>
#include <sstream>
#include <tuple>

#include "splat/image.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

using Eigen::Matrix3d;
using Eigen::Vector3f;

constexpr uint64_t kMaxEntryBytes = uint64_t(256) << 20;
constexpr double kMaxCm = 100000;  // any number in a catalogue

void appendUtf8(std::string* out, uint32_t code) {
  if (code < 0x80) {
    *out += char(code);
  } else if (code < 0x800) {
    *out += char(0xC0 | code >> 6);
    *out += char(0x80 | (code & 63));
  } else if (code < 0x10000) {
    *out += char(0xE0 | code >> 12);
    *out += char(0x80 | (code >> 6 & 63));
    *out += char(0x80 | (code & 63));
  } else {
    *out += char(0xF0 | code >> 18);
    *out += char(0x80 | (code >> 12 & 63));
    *out += char(0x80 | (code >> 6 & 63));
    *out += char(0x80 | (code & 63));
  }
}

/// UTF-8 of a key or value, escapes resolved. `where` names the file.
std::string unescaped(const std::string& latin1, const std::string& where) {
  const auto unit = [&](size_t at) {
    uint32_t value = 0;
    const char* const first = latin1.data() + std::min(at, latin1.size());
    const char* const last = latin1.data() + std::min(at + 4, latin1.size());
    const auto [end, failure] = std::from_chars(first, last, value, 16);
    require(failure == std::errc() && end == first + 4, "readProperties: ", where,
            ": expected four hexadecimal digits after \\u, found \"", std::string(first, last),
            "\"");
    return value;
  };
  std::string out;
  for (size_t i = 0; i < latin1.size(); ++i) {
    if (latin1[i] != '\\' || i + 1 == latin1.size()) {
      if (latin1[i] != '\\') appendUtf8(&out, uint8_t(latin1[i]));
      continue;
    }
    const char escape = latin1[++i];
    if (escape != 'u') {
      const size_t letter = std::string("tnrf").find(escape);
      appendUtf8(&out, letter == std::string::npos ? uint8_t(escape) : uint8_t("\t\n\r\f"[letter]));
      continue;
    }
    uint32_t code = unit(i + 1);
    i += 4;
    const bool is_pair = code >= 0xD800 && code < 0xDC00 && latin1.compare(i + 1, 2, "\\u") == 0;
    if (is_pair) {
      const uint32_t low = unit(i + 3);
      if (low >= 0xDC00 && low < 0xE000) {
        code = 0x10000 + ((code - 0xD800) << 10) + (low - 0xDC00);
        i += 6;
      }
    }
    appendUtf8(&out,
               code >= 0xD800 && code < 0xE000 ? 0xFFFD : code);  // half a pair is no character
  }
  return out;
}

/// Lines without comments and blank ones, continued lines (odd number of backslashes) joined.
std::vector<std::string> logicalLines(const std::string& text) {
  std::vector<std::string> lines;
  std::string whole;
  bool continued = false;
  for (size_t at = 0; at < text.size();) {
    const size_t end = std::min(text.find_first_of("\r\n", at), text.size());
    std::string line = text.substr(at, end - at);
    at = end + (text.compare(end, 2, "\r\n") == 0 ? 2 : 1);
    line.erase(0, std::min(line.find_first_not_of(" \t\f"), line.size()));
    if (!continued && (line.empty() || line[0] == '#' || line[0] == '!')) continue;
    const size_t last = line.find_last_not_of('\\');
    const size_t slashes = line.size() - (last == std::string::npos ? 0 : last + 1);
    continued = slashes % 2 == 1;
    if (continued) line.pop_back();
    whole += line;
    if (continued) continue;
    lines.push_back(whole);
    whole.clear();
  }
  if (!whole.empty()) lines.push_back(whole);
  return lines;
}

/// Lights, whose positions count from the left of the front in the plan, seen from above.
std::vector<ModelLight> readLights(const CatalogueEntry& entry, const Vector3f& size_m) {
  const std::vector<double> x = entry.numbers("lightSourceX"), y = entry.numbers("lightSourceY"),
                            z = entry.numbers("lightSourceZ"),
                            diameter = entry.numbers("lightSourceDiameter");
  std::istringstream in(entry.text("lightSourceColor"));
  std::vector<ModelLight> lights;
  for (std::string word; in >> word;) {
    const size_t i = lights.size();
    uint32_t rgb = 0;
    const auto [end, failure] = std::from_chars(word.data() + std::min<size_t>(1, word.size()),
                                                word.data() + word.size(), rgb, 16);
    require(word.size() == 7 && word[0] == '#' && failure == std::errc() &&
                end == word.data() + word.size() && i < std::min({x.size(), y.size(), z.size()}),
            "readCatalogue: ", entry.where, ": lightSourceColor#", entry.number,
            ": expected one #RRGGBB a light, found \"", word, "\"");
    ModelLight light;
    light.centre = {size_m.x() / 2 - float(x[i] / 100), size_m.y() / 2 - float(y[i] / 100),
                    float(z[i] / 100)};
    for (int c = 0; c < 3; ++c)
      light.colour[c] = linearFromSrgb(float(rgb >> (16 - 8 * c) & 255) / 255);
    if (i < diameter.size()) light.diameter_m = float(std::max(diameter[i], 0.) / 100);
    lights.push_back(light);
  }
  return lights;
}

}  // namespace

std::string lowerCase(std::string s) {
  for (char& c : s)
    if (c >= 'A' && c <= 'Z') c = char(c - 'A' + 'a');
  return s;
}

std::string trimmed(const std::string& s) {
  const size_t first = s.find_first_not_of(" \t\r\n"), last = s.find_last_not_of(" \t\r\n");
  return first == std::string::npos ? "" : s.substr(first, last - first + 1);
}

std::string baseName(const std::string& path) { return path.substr(path.find_last_of("/\\") + 1); }

CatalogueZip::CatalogueZip(const std::string& path) : ZipFile("readAsset", path) {
  for (const auto& [name, i] : entries()) by_base_[lowerCase(baseName(name))].push_back(name);
}

std::string CatalogueZip::locate(const std::string& folder, const std::string& file) const {
  if (has(folder + file)) return folder + file;
  const auto found = by_base_.find(lowerCase(baseName(file)));
  if (found == by_base_.end()) return "";
  for (const std::string& name : found->second)
    if (name.size() - baseName(name).size() == folder.size() &&
        !name.compare(0, folder.size(), folder))
      return name;
  return found->second.size() == 1 ? found->second[0] : "";
}

std::string CatalogueZip::read(const std::string& name) const {
  return ZipFile::read(name, kMaxEntryBytes);
}

Properties parseProperties(const std::string& text, const std::string& where) {
  Properties properties;
  for (const std::string& line : logicalLines(text)) {
    size_t end = 0;
    while (end < line.size() && !std::strchr("=: \t\f", line[end]))
      end += line[end] == '\\' ? 2 : 1;
    end = std::min(end, line.size());
    size_t value = std::min(line.find_first_not_of(" \t\f", end), line.size());
    if (value < line.size() && (line[value] == '=' || line[value] == ':'))
      value = std::min(line.find_first_not_of(" \t\f", value + 1), line.size());
    properties[unescaped(line.substr(0, end), where)] = unescaped(line.substr(value), where);
  }
  return properties;
}

std::vector<std::string> entryNumbers(const Properties& properties, const std::string& key) {
  std::vector<std::string> numbers;
  for (auto p = properties.lower_bound(key + "#"); p != properties.end(); ++p) {
    if (p->first.compare(0, key.size() + 1, key + "#") != 0) break;
    numbers.push_back(p->first.substr(key.size() + 1));
  }
  std::sort(numbers.begin(), numbers.end(), [](const std::string& a, const std::string& b) {
    return std::make_tuple(a.size(), a) < std::make_tuple(b.size(), b);
  });
  return numbers;
}

const std::string* CatalogueEntry::find(const std::string& key) const {
  const auto found = properties.find(key + "#" + number);
  return found == properties.end() ? nullptr : &found->second;
}

std::string CatalogueEntry::text(const std::string& key) const {
  const std::string* value = find(key);
  return value ? trimmed(*value) : "";
}

std::string CatalogueEntry::neededText(const std::string& key) const {
  const std::string value = text(key);
  require(!value.empty(), "readCatalogue: ", where, ": expected a value of ", key, "#", number,
          ", found none");
  return value;
}

std::vector<double> CatalogueEntry::numbers(const std::string& key) const {
  std::vector<double> values;
  std::istringstream in(text(key));
  for (std::string word; in >> word;) {
    double value = 0;
    const auto [end, failure] = std::from_chars(word.data(), word.data() + word.size(), value);
    require(failure == std::errc() && end == word.data() + word.size() && std::abs(value) <= kMaxCm,
            "readCatalogue: ", where, ": ", key, "#", number, ": expected a number up to ", kMaxCm,
            ", found \"", word, "\"");
    values.push_back(value);
  }
  return values;
}

double CatalogueEntry::number1(const std::string& key, std::optional<double> otherwise) const {
  if (otherwise && text(key).empty()) return *otherwise;
  const std::vector<double> values = numbers(key);
  require(values.size() == 1, "readCatalogue: ", where, ": ", key, "#", number,
          ": expected one number, found \"", text(key), "\"");
  return values[0];
}

float CatalogueEntry::sizeM(const std::string& key) const {
  const double cm = number1(key);
  require(cm > 0, "readCatalogue: ", where, ": ", key, "#", number,
          ": expected a positive size, found ", cm);
  return float(cm / 100);
}

Matrix3d readRotation(const CatalogueEntry& entry) {
  const std::vector<double> v = entry.numbers("modelRotation");
  if (v.empty()) return Matrix3d::Identity();
  require(v.size() == 9, "readCatalogue: ", entry.where, ": modelRotation#", entry.number,
          ": expected 9 numbers, found ", v.size());
  const Matrix3d rotation =
      Eigen::Map<const Eigen::Matrix<double, 3, 3, Eigen::RowMajor>>(v.data());
  require((rotation * rotation.transpose()).isIdentity(.01) && rotation.determinant() > 0,
          "readCatalogue: ", entry.where, ": modelRotation#", entry.number,
          ": expected a rotation, found \"", entry.text("modelRotation"), "\"");
  return rotation;
}

ModelInfo readModelInfo(const CatalogueEntry& entry, const std::string& catalogue,
                        const std::string& licence) {
  ModelInfo info;
  info.id = entry.neededText("id");
  info.name = entry.neededText("name");
  info.catalogue = catalogue;
  info.category = entry.text("category");
  info.creator = entry.text("creator");
  info.licence = licence;
  info.size_m = {entry.sizeM("width"), entry.sizeM("depth"), entry.sizeM("height")};
  info.elevation_m = float(entry.number1("elevation", 0) / 100);
  info.top_m = float(entry.number1("dropOnTopElevation", double(info.size_m.z()) * 100) / 100);
  info.is_door_or_window = lowerCase(entry.text("doorOrWindow")) == "true";
  info.lights = readLights(entry, info.size_m);
  return info;
}

std::string entryName(const std::string& path) { return path.substr(path[0] == '/' ? 1 : 0); }

std::string licenceOf(const Properties& properties) {
  const auto found = properties.find("license");
  return found == properties.end() ? "" : trimmed(found->second);
}

}  // namespace vdbc
