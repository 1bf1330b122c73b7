#include "examples/rooms/assets.h"

#include <tiny_obj_loader.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <mutex>
#include <numeric>
#include <optional>
#include <random>
#include <set>
#include <sstream>
#include <tuple>
#include <unordered_map>

#include "encoder/views/zip_file.h"
#include "splat/image_files.h"
#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Matrix3d;
using Eigen::Vector2d;
using Eigen::Vector2f;
using Eigen::Vector3d;
using Eigen::Vector3f;
using Properties = std::map<std::string, std::string>;

constexpr uint64_t kMaxEntryBytes = uint64_t(256) << 20;
constexpr int kMaxTextureSide = 1024;  // larger ones are halved: no picture of a room shows more
constexpr size_t kMaxTriangles = 400000;
constexpr size_t kMaxReadTriangles = 4000000;
constexpr size_t kMaxPolygonCorners = 1024;
constexpr float kMaxReflectance = .85f;  // fresh snow; brighter surfaces would glow
constexpr double kMaxCm = 100000;        // any number in a catalogue
constexpr double kMaxStretch = 3;  // a model is stretched unequally to its size by at most this
constexpr double kMaxShareWithoutMaterial = .5;  // of triangles; up to this they turn grey
constexpr const char* kJarName = "sweethome3d.jar";
constexpr const char* kJarFolder = "com/eteks/sweethome3d/io/";
constexpr std::array<const char*, 5> kCatalogueNames = {"BlendSwap-CC-0.sh3f",
                                                        "BlendSwap-CC-BY.sh3f", "KatorLegaz.sh3f",
                                                        "Reallusion.sh3f", "Scopia.sh3f"};

std::string lowerCase(std::string s) {
  for (char& c : s)
    if (c >= 'A' && c <= 'Z') c = char(c - 'A' + 'a');
  return s;
}

std::string trimmed(const std::string& s) {
  const size_t first = s.find_first_not_of(" \t\r\n"), last = s.find_last_not_of(" \t\r\n");
  return first == std::string::npos ? "" : s.substr(first, last - first + 1);
}

std::vector<std::string> splitAt(const std::string& s, char separator) {
  std::vector<std::string> parts;
  std::istringstream in(s);
  for (std::string part; std::getline(in, part, separator);) parts.push_back(part);
  return parts;
}

/// What is behind the last slash of either kind: texture paths come from any system.
std::string baseName(const std::string& path) { return path.substr(path.find_last_of("/\\") + 1); }

// ---- zip files

/// A zip file whose entries refer to each other by name.
class CatalogueZip : public ZipFile {
 public:
  explicit CatalogueZip(const std::string& path) : ZipFile("readAsset", path) {
    for (const auto& [name, i] : entries()) by_base_[lowerCase(baseName(name))].push_back(name);
  }

  /// Name of the entry `file` refers to, seen from `folder` ("" or ending in a slash): its path;
  /// else its base name, in any case, in the folder; else the only entry of that base name. "" if
  /// none.
  std::string locate(const std::string& folder, const std::string& file) const {
    if (has(folder + file)) return folder + file;
    const auto found = by_base_.find(lowerCase(baseName(file)));
    if (found == by_base_.end()) return "";
    for (const std::string& name : found->second)
      if (name.size() - baseName(name).size() == folder.size() &&
          !name.compare(0, folder.size(), folder))
        return name;
    return found->second.size() == 1 ? found->second[0] : "";
  }

  std::string read(const std::string& name) const { return ZipFile::read(name, kMaxEntryBytes); }

 private:
  std::unordered_map<std::string, std::vector<std::string>> by_base_;
};

// ---- Java properties files: Latin-1, with escapes

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

/// One numbered entry of a catalogue: its properties without the number, and how to complain.
struct Entry {
  const Properties& properties;
  std::string number, where;

  const std::string* find(const std::string& key) const {
    const auto found = properties.find(key + "#" + number);
    return found == properties.end() ? nullptr : &found->second;
  }
  std::string text(const std::string& key) const {
    const std::string* value = find(key);
    return value ? trimmed(*value) : "";
  }
  std::string neededText(const std::string& key) const {
    const std::string value = text(key);
    require(!value.empty(), "readCatalogue: ", where, ": expected a value of ", key, "#", number,
            ", found none");
    return value;
  }
  std::vector<double> numbers(const std::string& key) const {
    std::vector<double> values;
    std::istringstream in(text(key));
    for (std::string word; in >> word;) {
      double value = 0;
      const auto [end, failure] = std::from_chars(word.data(), word.data() + word.size(), value);
      require(
          failure == std::errc() && end == word.data() + word.size() && std::abs(value) <= kMaxCm,
          "readCatalogue: ", where, ": ", key, "#", number, ": expected a number up to ", kMaxCm,
          ", found \"", word, "\"");
      values.push_back(value);
    }
    return values;
  }
  double number1(const std::string& key, std::optional<double> otherwise = {}) const {
    if (otherwise && text(key).empty()) return *otherwise;
    const std::vector<double> values = numbers(key);
    require(values.size() == 1, "readCatalogue: ", where, ": ", key, "#", number,
            ": expected one number, found \"", text(key), "\"");
    return values[0];
  }
  float sizeM(const std::string& key) const {
    const double cm = number1(key);
    require(cm > 0, "readCatalogue: ", where, ": ", key, "#", number,
            ": expected a positive size, found ", cm);
    return float(cm / 100);
  }
};

/// Numbers of a catalogue's entries, in order: those that have `key`.
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

// ---- Catalogues

struct ModelSource {
  const CatalogueZip* zip = nullptr;
  std::string obj;                           // name of the entry
  Matrix3d rotation = Matrix3d::Identity();  // in OBJ space, before all else
};
struct TextureSource {
  const CatalogueZip* zip = nullptr;
  std::string image;
};

Matrix3d readRotation(const Entry& entry) {
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

/// Lights, whose positions count from the left of the front in the plan, seen from above.
std::vector<ModelLight> readLights(const Entry& entry, const Vector3f& size_m) {
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

ModelInfo readModelInfo(const Entry& entry, const std::string& catalogue,
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

/// Path of a catalogue as the name of a zip entry: without its leading slash.
std::string entryName(const std::string& path) { return path.substr(path[0] == '/' ? 1 : 0); }

std::string licenceOf(const Properties& properties) {
  const auto found = properties.find("license");
  return found == properties.end() ? "" : trimmed(found->second);
}

// ---- models.tsv: what is known of a model beyond its catalogue

struct TableRow {
  std::string split, role, fault;
};
using Table = std::map<std::string, TableRow>;

Table readTable(const std::string& path) {
  std::ifstream in(path);
  require(bool(in), "openAssets: ", path,
          ": cannot open for reading (expected the table of models)");
  Table table;
  int number = 0;
  for (std::string line; std::getline(in, line);) {
    ++number;
    if (line.empty() || line[0] == '#') continue;
    std::vector<std::string> cells = splitAt(line, '\t');
    if (cells.size() == 3) cells.emplace_back();  // nothing after the last tab
    require(cells.size() == 4, "openAssets: ", path, ":", number,
            ": expected id, split, role and fault, found ", cells.size(), " columns");
    const bool is_new = table.emplace(cells[0], TableRow{cells[1], cells[2], cells[3]}).second;
    require(is_new, "openAssets: ", path, ":", number, ": expected each id once, found ", cells[0],
            " again");
  }
  return table;
}

// ---- Images

/// Half the size, by means of 2 x 2 pixels.
Texture halved(const Texture& t) {
  Texture half;
  half.width = std::max(t.width / 2, 1), half.height = std::max(t.height / 2, 1);
  half.rgba.resize(size_t(half.width) * size_t(half.height) * 4);
  const auto at = [&](int x, int y, int c) {
    x = std::min(x, t.width - 1), y = std::min(y, t.height - 1);
    return int(t.rgba[(size_t(y) * size_t(t.width) + size_t(x)) * 4 + size_t(c)]);
  };
  for (int y = 0; y < half.height; ++y)
    for (int x = 0; x < half.width; ++x)
      for (int c = 0; c < 4; ++c)
        half.rgba[(size_t(y) * size_t(half.width) + size_t(x)) * 4 + size_t(c)] =
            uint8_t((at(2 * x, 2 * y, c) + at(2 * x + 1, 2 * y, c) + at(2 * x, 2 * y + 1, c) +
                     at(2 * x + 1, 2 * y + 1, c) + 2) /
                    4);
  return half;
}

Texture readTexture(const CatalogueZip& zip, const std::string& entry) {
  const std::string bytes = zip.read(entry), where = zip.path() + ": " + entry;
  Texture texture;
  texture.rgba =
      decodeRgba("readTexture", where, bytes.data(), bytes.size(), &texture.width, &texture.height);
  while (std::max(texture.width, texture.height) > kMaxTextureSide) texture = halved(texture);
  for (size_t i = 3; i < texture.rgba.size(); i += 4) texture.has_alpha |= texture.rgba[i] < 255;
  return texture;
}

/// Scene-linear mean, of what is covered.
Vector3f meanColour(const Texture& texture) {
  Vector3d sum = Vector3d::Zero();
  double weight = 0;
  for (size_t i = 0; i < texture.rgba.size(); i += 4) {
    const double cover = texture.rgba[i + 3] / 255.;
    for (int c = 0; c < 3; ++c)
      sum[c] += cover * double(linearFromSrgb(float(texture.rgba[i + size_t(c)]) / 255));
    weight += cover;
  }
  return weight > 0 ? Vector3f((sum / weight).cast<float>()) : Vector3f::Constant(.5f);
}

// ---- Materials

/// What names without a material file mean: names of Java3D's, colours (display sRGB) by what they
/// say. Those that begin with fl ("flat") do not shine.
struct NamedColour {
  const char* name;
  float r, g, b;
};
constexpr NamedColour kNamedColours[] = {
    {"amber", .8f, .55f, .1f},        {"archwhite", .92f, .92f, .88f},
    {"archwhite2", .9f, .9f, .85f},   {"black", .05f, .05f, .05f},
    {"bluegrey", .4f, .45f, .55f},    {"bluteal", .15f, .45f, .5f},
    {"bone", .85f, .8f, .68f},        {"bone2", .82f, .76f, .62f},
    {"brown", .4f, .26f, .15f},       {"brownlips", .5f, .28f, .22f},
    {"brzskin", .6f, .42f, .3f},      {"dkblue", .08f, .1f, .4f},
    {"dkdkgrey", .15f, .15f, .15f},   {"dkgrey", .28f, .28f, .28f},
    {"dkred", .45f, .05f, .05f},      {"flblack", .05f, .05f, .05f},
    {"flblonde", .8f, .68f, .45f},    {"flbrown", .4f, .26f, .15f},
    {"fldkdkgrey", .15f, .15f, .15f}, {"fldkgrey", .28f, .28f, .28f},
    {"flesh", .85f, .65f, .5f},       {"flgrey", .5f, .5f, .5f},
    {"flltbrown", .6f, .44f, .28f},   {"flltgrey", .72f, .72f, .72f},
    {"florange", .9f, .45f, .1f},     {"fltan", .75f, .62f, .45f},
    {"flwhite", .93f, .93f, .93f},    {"flwhite1", .9f, .9f, .9f},
    {"flyellow", .9f, .82f, .3f},     {"grey", .5f, .5f, .5f},
    {"iris", .3f, .3f, .6f},          {"jetflame", .95f, .6f, .2f},
    {"lavendar", .7f, .6f, .85f},     {"lighttan", .8f, .7f, .55f},
    {"lighttan2", .78f, .68f, .52f},  {"lighttannew", .8f, .7f, .55f},
    {"ltgrey", .72f, .72f, .72f},     {"offwhite.warm", .9f, .87f, .8f},
    {"red", .75f, .08f, .08f},        {"redwood", .5f, .24f, .15f},
    {"ruby", .55f, .05f, .12f},       {"sand_stone", .76f, .68f, .52f},
    {"ship2", .45f, .47f, .5f},       {"silver", .75f, .75f, .76f},
    {"sky_blue", .5f, .7f, .9f},      {"tan", .72f, .58f, .4f},
    {"teeth", .93f, .9f, .82f},       {"white", .93f, .93f, .93f},
    {"yellow", .9f, .8f, .15f},       {"yellow_green", .6f, .7f, .25f},
    {"yellowbrt", .95f, .88f, .2f}};

/// The named colours as a material file.
std::string namedColoursMtl() {
  std::ostringstream out;
  for (const NamedColour& colour : kNamedColours) {
    const bool is_flat = std::string(colour.name).compare(0, 2, "fl") == 0 && colour.name[2] != 'e';
    out << "newmtl " << colour.name << "\nKd " << colour.r << ' ' << colour.g << ' ' << colour.b
        << (is_flat ? "\nillum 1\n" : "\nKs .3 .3 .3\nNs 60\nillum 2\n");
  }
  return out.str();
}

/// Finds material files in the catalogue. LoadObj only asks for what an OBJ names, so that one
/// without a file is given the line "mtllib", whose empty name nothing has.
class CatalogueMaterials : public tinyobj::MaterialReader {
 public:
  CatalogueMaterials(const CatalogueZip& zip, std::string obj) : zip_(zip), obj_(std::move(obj)) {}

  bool operator()(const std::string& name, std::vector<tinyobj::material_t>* materials,
                  std::map<std::string, int>* ids, std::string* warn, std::string* error) override {
    const std::string folder = obj_.substr(0, obj_.size() - baseName(obj_).size());
    std::string entry = zip_.locate(folder, name);
    if (entry.empty())
      entry = zip_.locate(folder, fs::path(baseName(obj_)).stem().string() + ".mtl");
    if (!entry.empty()) {
      std::istringstream file(zip_.read(entry));
      tinyobj::LoadMtl(ids, materials, &file, warn, error);
    }
    std::istringstream named(namedColoursMtl());
    tinyobj::LoadMtl(ids, materials, &named, warn, error);  // does not replace what is there
    return true;
  }

 private:
  const CatalogueZip& zip_;
  std::string obj_;
};

Vector3f linearColour(const tinyobj::real_t (&display)[3]) {
  Vector3f linear;
  for (int c = 0; c < 3; ++c) {
    const float value = std::isfinite(display[c]) ? std::clamp(float(display[c]), 0.f, 1.f) : .5f;
    linear[c] = std::min(linearFromSrgb(value), kMaxReflectance);
  }
  return linear;
}

float largest(const tinyobj::real_t (&v)[3]) {
  const float m = std::max({v[0], v[1], v[2]});
  return std::isfinite(m) ? std::clamp(m, 0.f, 1.f) : 0.f;
}

/// Factor of a texture: exporters' greys and black mean no tint.
Vector3f textureFactor(const tinyobj::real_t (&kd)[3]) {
  const float low = std::min({kd[0], kd[1], kd[2]}), high = largest(kd);
  const bool is_neutral = high - low < .02f && (high < .02f || high >= .3f);
  return is_neutral ? Vector3f::Constant(kMaxReflectance) : linearColour(kd);
}

/// Material without its texture.
Material plainMaterial(const tinyobj::material_t& m, bool has_lights) {
  Material out;
  out.name = m.name;
  out.colour_a = linearColour(m.diffuse);
  // Squared: Phong's weights are higher than the reflectance of the plastics they stand for.
  const float shine = m.illum == 0 || m.illum == 1 ? 0.f : largest(m.specular);
  out.specular = std::min(.25f * shine * shine, .3f);
  const float exponent = std::isfinite(m.shininess) ? std::max(float(m.shininess), 0.f) : 0.f;
  out.roughness = std::clamp(std::sqrt(2 / (exponent + 2)), .05f, 1.f);
  out.opacity = std::isfinite(m.dissolve) ? std::clamp(float(m.dissolve), 0.f, 1.f) : 1.f;
  if (out.opacity <= kSolidOpacity)
    out.opacity = std::min(out.opacity, .9f * kSolidOpacity);  // glass is often .5
  const float glow = largest(m.emission);
  if (has_lights && glow > 0) {
    out.emission = glow;
    if (out.colour_a.maxCoeff() < .01f) out.colour_a = linearColour(m.emission);
  }
  return out;
}

// ---- Geometry

/// What mesh() hands out: the surface, and what was mended and found wrong on the way.
struct ReadMesh : SurfaceMesh {
  std::string note, fault;
};

void addNote(std::string* note, const std::string& text) {
  *note += (note->empty() ? "" : "; ") + text;
}

/// Corner of a face: indices into the file's arrays; -1: has none.
struct Corner {
  int vertex = -1, uv = -1, normal = -1;
};
/// What Sweet Home 3D's names of groups say of a surface whatever its material.
enum class Finish { kOwn, kPane, kMirror };
constexpr int kNoMaterial = -1,
              kUnknownMaterial = -2;  // a face of no material, of an undefined one
struct Face {
  std::array<Corner, 3> corner;
  int material = kNoMaterial;
  Finish finish = Finish::kOwn;
};

/// An OBJ file; what tinyobj's callbacks fill. Its own triangulation folds concave polygons over
/// (Debian's 2.0 rc10), so that polygons are cut up here.
struct ObjFile {
  std::vector<Vector3f> vertices, normals;
  std::vector<Vector2f> uv;
  std::vector<tinyobj::material_t> materials;
  std::vector<Face> faces;
  size_t lines = 0;     // faces of two corners
  std::string problem;  // callbacks can't throw through tinyobj

  int material = kNoMaterial;  // of the faces that follow
  Finish finish = Finish::kOwn;
};

/// 0-based index from an OBJ's, which counts from 1, or back from the end; -1: has none; -2: wrong.
int fromObjIndex(int index, size_t count) {
  if (index == 0) return -1;
  if (index > 0) return size_t(index) <= count ? index - 1 : -2;
  return int64_t(count) + index >= 0 ? int(int64_t(count) + index) : -2;
}

/// Corners of a polygon in its plane.
std::vector<Vector2d> flattened(const ObjFile& obj, const std::vector<Corner>& polygon) {
  Vector3d normal = Vector3d::Zero();
  const Vector3d origin = obj.vertices[size_t(polygon[0].vertex)].cast<double>();
  std::vector<Vector3d> points;
  for (const Corner& c : polygon)
    points.push_back(obj.vertices[size_t(c.vertex)].cast<double>() - origin);
  for (size_t i = 0; i < points.size(); ++i)
    normal += points[i].cross(points[(i + 1) % points.size()]);
  const Vector3d u = normal.unitOrthogonal(), v = normal.normalized().cross(u);
  std::vector<Vector2d> flat;
  for (const Vector3d& p : points) flat.emplace_back(u.dot(p), v.dot(p));
  return flat;
}

double turnOf(const Vector2d& a, const Vector2d& b, const Vector2d& c) {
  return (b - a).x() * (c - a).y() - (b - a).y() * (c - a).x();
}

/// Whether the corner after `before` can be cut off: it bulges, and no other corner is in the way.
/// Holes hang on bridges, whose ends are there twice: corners at the triangle's own do not count.
bool isEar(const std::vector<Vector2d>& p, const std::vector<size_t>& left, size_t at) {
  const size_t n = left.size();
  const Vector2d &a = p[left[(at + n - 1) % n]], &b = p[left[at]], &c = p[left[(at + 1) % n]];
  if (turnOf(a, b, c) <= 0) return false;
  return std::none_of(left.begin(), left.end(), [&](size_t i) {
    const Vector2d& q = p[i];
    return q != a && q != b && q != c && turnOf(a, b, q) >= 0 && turnOf(b, c, q) >= 0 &&
           turnOf(c, a, q) >= 0;
  });
}

/// Triangles of a polygon, as places in it: ear clipping; of a quad's two cuts the shorter.
std::vector<std::array<size_t, 3>> triangulated(const ObjFile& obj,
                                                const std::vector<Corner>& polygon) {
  if (polygon.size() == 3) return {{0, 1, 2}};
  const std::vector<Vector2d> p = flattened(obj, polygon);
  std::vector<size_t> left(polygon.size());
  std::iota(left.begin(), left.end(), size_t(0));
  std::vector<std::array<size_t, 3>> triangles;
  while (left.size() > 3) {
    const size_t n = left.size();
    size_t best = n;
    double best_cut = 0;
    for (size_t i = 0; i < n && (best == n || n == 4); ++i) {
      if (!isEar(p, left, i)) continue;
      const double cut = (p[left[(i + 1) % n]] - p[left[(i + n - 1) % n]]).squaredNorm();
      if (best == n || cut < best_cut) best = i, best_cut = cut;
    }
    if (best == n) best = 0;  // a polygon that crosses itself: any cut is as good
    triangles.push_back({left[(best + n - 1) % n], left[best], left[(best + 1) % n]});
    left.erase(left.begin() + std::ptrdiff_t(best));
  }
  triangles.push_back({left[0], left[1], left[2]});
  return triangles;
}

void addFace(ObjFile* obj, const tinyobj::index_t* indices, int count) {
  if (count < 3) {
    ++obj->lines;
    return;
  }
  if (size_t(count) > kMaxPolygonCorners) {
    obj->problem = joinText("polygon of more than ", kMaxPolygonCorners, " corners");
    return;
  }
  std::vector<Corner> polygon;
  for (int k = 0; k < count; ++k) {
    const Corner c{fromObjIndex(indices[k].vertex_index, obj->vertices.size()),
                   fromObjIndex(indices[k].texcoord_index, obj->uv.size()),
                   fromObjIndex(indices[k].normal_index, obj->normals.size())};
    if (c.vertex < 0 || c.uv < -1 || c.normal < -1) {
      obj->problem = "index out of range";
      return;
    }
    polygon.push_back(c);
  }
  for (const auto& t : triangulated(*obj, polygon)) {
    if (obj->faces.size() > kMaxReadTriangles) {
      obj->problem = joinText("more than ", kMaxReadTriangles, " triangles");
      return;
    }
    obj->faces.push_back(
        {{polygon[t[0]], polygon[t[1]], polygon[t[2]]}, obj->material, obj->finish});
  }
}

ObjFile readObj(const CatalogueZip& zip, const std::string& entry) {
  std::string text = zip.read(entry);
  if (text.find("mtllib") == std::string::npos) text = "mtllib named\n" + text;
  std::istringstream in(text);
  tinyobj::callback_t callbacks;
  callbacks.vertex_cb = [](void* data, float x, float y, float z, float) {
    static_cast<ObjFile*>(data)->vertices.emplace_back(x, y, z);
  };
  callbacks.normal_cb = [](void* data, float x, float y, float z) {
    static_cast<ObjFile*>(data)->normals.emplace_back(x, y, z);
  };
  callbacks.texcoord_cb = [](void* data, float x, float y, float) {
    static_cast<ObjFile*>(data)->uv.emplace_back(x, y);
  };
  callbacks.index_cb = [](void* data, tinyobj::index_t* indices, int count) {
    auto* obj = static_cast<ObjFile*>(data);
    if (obj->problem.empty()) addFace(obj, indices, count);
  };
  callbacks.usemtl_cb = [](void* data, const char*, int material) {
    static_cast<ObjFile*>(data)->material = material >= 0 ? material : kUnknownMaterial;
  };
  callbacks.mtllib_cb = [](void* data, const tinyobj::material_t* materials, int count) {
    static_cast<ObjFile*>(data)->materials.assign(materials, materials + count);
  };
  callbacks.group_cb = [](void* data, const char** names, int count) {
    const std::string name = count > 0 ? names[0] : "";
    const bool is_pane = name.compare(0, 23, "sweethome3d_window_pane") == 0,
               is_mirror = name.compare(0, 25, "sweethome3d_window_mirror") == 0;
    static_cast<ObjFile*>(data)->finish = is_pane     ? Finish::kPane
                                          : is_mirror ? Finish::kMirror
                                                      : Finish::kOwn;
  };
  ObjFile obj;
  CatalogueMaterials reader(zip, entry);
  std::string warnings, error;
  const bool ok = tinyobj::LoadObjWithCallback(in, callbacks, &obj, &reader, &warnings, &error);
  require(ok, "readModel: ", zip.path(), ": ", entry, ": ", trimmed(error));
  require(obj.problem.empty(), "readModel: ", zip.path(), ": ", entry, ": ", obj.problem);
  for (const Vector3f& v : obj.vertices)
    require(v.allFinite(), "readModel: ", zip.path(), ": ", entry,
            ": expected finite vertices, found ", v.transpose());
  return obj;
}

Vector3d vertexOf(const ObjFile& obj, const Corner& corner) {
  return obj.vertices[size_t(corner.vertex)].cast<double>();
}

bool isDegenerate(const ObjFile& obj, const Face& face) {
  std::array<Vector3d, 3> p;
  for (size_t k = 0; k < 3; ++k) p[k] = vertexOf(obj, face.corner[k]);
  const double longest = std::max(
      {(p[1] - p[0]).squaredNorm(), (p[2] - p[1]).squaredNorm(), (p[0] - p[2]).squaredNorm()});
  return (p[1] - p[0]).cross(p[2] - p[0]).norm() <= 1e-7 * longest;
}

/// Drops what has no area.
void dropDegenerate(ObjFile* obj, const std::string& where, std::string* note) {
  const size_t all = obj->faces.size();
  const auto kept = std::remove_if(obj->faces.begin(), obj->faces.end(),
                                   [&](const Face& face) { return isDegenerate(*obj, face); });
  obj->faces.erase(kept, obj->faces.end());
  if (obj->lines > 0) addNote(note, joinText(obj->lines, " faces of two corners dropped"));
  if (obj->faces.size() < all)
    addNote(note, joinText(all - obj->faces.size(), " degenerate triangles dropped"));
  require(!obj->faces.empty(), "readModel: ", where, ": no triangles");
}

/// Ratio of the largest to the smallest factor that turns one size into another, flat axes aside.
double stretch(const Vector3d& from, const Vector3d& to) {
  double least = 0, most = 0;
  for (int a = 0; a < 3; ++a) {
    if (from[a] <= 1e-6 * from.maxCoeff()) continue;
    const double factor = to[a] / from[a];
    least = least > 0 ? std::min(least, factor) : factor;
    most = std::max(most, factor);
  }
  return least > 0 ? most / least : 1;
}

/// Model frame from OBJ space: turned, stretched to the catalogue's size, set on the floor.
Eigen::Affine3d modelFromObj(const ObjFile& obj, const Matrix3d& rotation, const Vector3f& size_m,
                             const std::string& where, std::string* fault) {
  Matrix3d axes;
  axes << -1, 0, 0, 0, 0, 1, 0, 1, 0;
  const Matrix3d turn = axes * rotation;
  Eigen::AlignedBox3d box;
  for (const Face& face : obj.faces)
    for (const Corner& corner : face.corner) box.extend(turn * vertexOf(obj, corner));
  const Vector3d found = box.sizes(), wanted = size_m.cast<double>();
  Vector3d scale = Vector3d::Ones();
  int sides = 0;
  for (int a = 0; a < 3; ++a)
    if (found[a] > 1e-6 * found.maxCoeff()) scale[a] = wanted[a] / found[a], ++sides;
  require(sides >= 2 && scale.allFinite(), "readModel: ", where, ": a line without width");
  const double as_is = stretch(found, wanted),
               turned = stretch(found, {wanted.y(), wanted.x(), wanted.z()});
  if (as_is > 1.5 && turned < 1.1)
    *fault = "rotation and size do not agree";
  else if (as_is > kMaxStretch)
    *fault = joinText("stretched ", std::round(as_is * 10) / 10, " to 1");
  Eigen::Affine3d to_model = Eigen::Affine3d::Identity();
  to_model.linear() = scale.asDiagonal() * turn;
  const Vector3d foot(box.center().x(), box.center().y(), box.min().z());
  to_model.translation() = -(scale.asDiagonal() * foot);
  return to_model;
}

/// Corner normals in the model frame, on the side the triangle faces; zero (all) where one lacks.
std::array<Vector3f, 3> cornerNormals(const ObjFile& obj, const Face& face, const Matrix3d& turn,
                                      const Vector3d& face_normal) {
  const std::array<Vector3f, 3> none = {Vector3f::Zero(), Vector3f::Zero(), Vector3f::Zero()};
  std::array<Vector3f, 3> normals;
  for (size_t k = 0; k < 3; ++k) {
    const int index = face.corner[k].normal;
    if (index < 0) return none;
    Vector3d n = turn * obj.normals[size_t(index)].cast<double>();
    const double length = n.norm();
    if (!std::isfinite(length) || length < 1e-12) return none;
    if (n.dot(face_normal) < 0) n = -n;
    normals[k] = (n / length).cast<float>();
  }
  return normals;
}

void fillGeometry(const ObjFile& obj, const Eigen::Affine3d& to_model, ReadMesh* out) {
  const Matrix3d turn = to_model.linear().inverse().transpose();
  std::vector<int> vertex(obj.vertices.size(), -1);
  for (const Face& face : obj.faces) {
    Eigen::Vector3i triangle;
    std::array<Vector3d, 3> p;
    std::array<Vector2f, 3> uv;
    uv.fill(Vector2f::Zero());
    for (size_t k = 0; k < 3; ++k) {
      const Corner& corner = face.corner[k];
      p[k] = to_model * vertexOf(obj, corner);
      int& index = vertex[size_t(corner.vertex)];
      if (index < 0) {
        index = int(out->mesh.vertices.size());
        out->mesh.vertices.push_back(p[k].cast<float>());
      }
      triangle[int(k)] = index;
      if (corner.uv >= 0 && obj.uv[size_t(corner.uv)].allFinite())
        uv[k] = obj.uv[size_t(corner.uv)];
    }
    out->mesh.triangles.push_back(triangle);
    out->uv.push_back(uv);
    out->normal.push_back(cornerNormals(obj, face, turn, (p[1] - p[0]).cross(p[2] - p[0])));
  }
}

/// A material as a window's pane or a mirror, which Sweet Home 3D knows by the name of the group.
Material finished(Material m, Finish finish) {
  if (finish == Finish::kPane) {
    m.opacity = std::min(m.opacity, .3f);
    m.specular = std::max(m.specular, .04f);
    m.roughness = .05f;
  } else if (finish == Finish::kMirror) {
    m.colour_a.setConstant(.03f);
    m.texture = nullptr;
    m.specular = .85f;
    m.roughness = 0;
  }
  return m;
}

}  // namespace

// ---- The library

struct AssetLibrary::Impl {
  std::vector<std::unique_ptr<CatalogueZip>> zips;
  const CatalogueZip* jar = nullptr;
  std::vector<ModelInfo> models;
  std::vector<ModelSource> sources;
  std::map<std::string, size_t> by_id;
  std::vector<TextureInfo> textures;
  std::vector<TextureSource> texture_sources;

  std::mutex mutex;  // of what is kept
  std::map<size_t, std::shared_ptr<const ReadMesh>> meshes;
  std::map<std::pair<const CatalogueZip*, std::string>, std::shared_ptr<const Texture>> images;

  void addModels(const CatalogueZip& zip, const std::string& properties_name,
                 const std::string& catalogue);
  void addTextures(const CatalogueZip& zip, const std::string& properties_name);
  void applyTable(const Table& table);

  std::shared_ptr<const Texture> image(const CatalogueZip& zip, const std::string& entry);
  std::shared_ptr<const Texture> textureOf(const ModelSource& source, const tinyobj::material_t& m,
                                           std::string* note);
  Material readMaterial(const tinyobj::material_t& m, size_t model, bool has_uv, std::string* note);
  void fillMaterials(const ObjFile& obj, size_t model, ReadMesh* out);
  std::shared_ptr<const ReadMesh> readMesh(size_t model);
};

void AssetLibrary::Impl::addModels(const CatalogueZip& zip, const std::string& properties_name,
                                   const std::string& catalogue) {
  const std::string where = zip.path() + ": " + properties_name;
  const Properties properties = parseProperties(zip.read(properties_name), where);
  for (const std::string& number : entryNumbers(properties, "model")) {
    const Entry entry{properties, number, where};
    models.push_back(readModelInfo(entry, catalogue, licenceOf(properties)));
    sources.push_back({&zip, entryName(entry.neededText("model")), readRotation(entry)});
    const bool is_new = by_id.emplace(models.back().id, models.size() - 1).second;
    require(is_new, "readCatalogue: ", where, ": expected each id once, found ", models.back().id,
            " again");
  }
}

void AssetLibrary::Impl::addTextures(const CatalogueZip& zip, const std::string& properties_name) {
  const std::string where = zip.path() + ": " + properties_name;
  const Properties properties = parseProperties(zip.read(properties_name), where);
  for (const std::string& number : entryNumbers(properties, "image")) {
    const Entry entry{properties, number, where};
    TextureInfo info;
    info.id = entry.neededText("id");
    info.name = entry.neededText("name");
    info.category = entry.text("category");
    info.size_m = {entry.sizeM("width"), entry.sizeM("height")};
    textures.push_back(info);
    texture_sources.push_back({&zip, entryName(entry.neededText("image"))});
  }
}

void AssetLibrary::Impl::applyTable(const Table& table) {
  for (ModelInfo& model : models) {
    const auto row = table.find(model.id);
    model.role = row == table.end() ? "none" : row->second.role;
    if (row == table.end()) continue;
    model.fault = row->second.fault;
    model.is_held_out = row->second.split == "held-out";
  }
}

std::shared_ptr<const Texture> AssetLibrary::Impl::image(const CatalogueZip& zip,
                                                         const std::string& entry) {
  const std::pair<const CatalogueZip*, std::string> key(&zip, entry);
  {
    const std::lock_guard<std::mutex> lock(mutex);
    const auto found = images.find(key);
    if (found != images.end()) return found->second;
  }
  auto texture = std::make_shared<const Texture>(readTexture(zip, entry));
  const std::lock_guard<std::mutex> lock(mutex);
  return images.emplace(key, texture).first->second;
}

/// A material's texture; null, and a note, where it names one that is not there.
std::shared_ptr<const Texture> AssetLibrary::Impl::textureOf(const ModelSource& source,
                                                             const tinyobj::material_t& m,
                                                             std::string* note) {
  const std::string name = trimmed(m.diffuse_texname);
  if (name.empty()) return nullptr;
  const std::string folder = source.obj.substr(0, source.obj.size() - baseName(source.obj).size());
  const std::string entry = source.zip->locate(folder, name);
  if (entry.empty()) {
    addNote(note, "texture " + baseName(name) + " missing, diffuse colour instead");
    return nullptr;
  }
  return image(*source.zip, entry);
}

/// A material of the file, made to show; `has_uv` of whether any of its faces has coordinates.
Material AssetLibrary::Impl::readMaterial(const tinyobj::material_t& m, size_t model, bool has_uv,
                                          std::string* note) {
  Material material = plainMaterial(m, !models[model].lights.empty());
  const std::shared_ptr<const Texture> texture = textureOf(sources[model], m, note);
  if (texture && has_uv) {
    material.texture = texture;
    material.colour_a = textureFactor(m.diffuse);
  } else if (texture) {
    addNote(note, "texture without coordinates, its mean colour instead");
    material.colour_a = meanColour(*texture).cwiseMin(kMaxReflectance);
  }
  return material;
}

void AssetLibrary::Impl::fillMaterials(const ObjFile& obj, size_t model, ReadMesh* out) {
  std::set<int> has_uv;
  for (const Face& face : obj.faces)
    if (face.corner[0].uv >= 0) has_uv.insert(face.material);
  std::map<std::pair<int, Finish>, int32_t> index;
  size_t without = 0;  // triangles whose material is not defined
  for (const Face& face : obj.faces) {
    const int id = face.material;
    without += id == kUnknownMaterial;
    const auto [place, is_new] =
        index.emplace(std::pair(id, face.finish), int32_t(out->materials.size()));
    if (is_new) {
      const Material material = id >= 0 ? readMaterial(obj.materials.at(size_t(id)), model,
                                                       has_uv.count(id) > 0, &out->note)
                                        : Material();
      out->materials.push_back(finished(material, face.finish));
    }
    out->material.push_back(place->second);
  }
  if (without == 0) return;
  addNote(&out->note, joinText(without, " triangles without a material"));
  if (double(without) > kMaxShareWithoutMaterial * double(obj.faces.size()))
    out->fault = "material missing";
}

std::shared_ptr<const ReadMesh> AssetLibrary::Impl::readMesh(size_t model) {
  {
    const std::lock_guard<std::mutex> lock(mutex);
    const auto found = meshes.find(model);
    if (found != meshes.end()) return found->second;
  }
  const ModelSource& source = sources[model];
  const std::string where = source.zip->path() + ": " + source.obj;
  auto out = std::make_shared<ReadMesh>();
  ObjFile obj = readObj(*source.zip, source.obj);
  dropDegenerate(&obj, where, &out->note);
  fillGeometry(obj, modelFromObj(obj, source.rotation, models[model].size_m, where, &out->fault),
               out.get());
  fillMaterials(obj, model, out.get());
  if (obj.faces.size() > kMaxTriangles)
    out->fault = joinText("too fine: ", obj.faces.size(), " triangles");
  const std::lock_guard<std::mutex> lock(mutex);
  return meshes.emplace(model, out).first->second;
}

AssetLibrary::AssetLibrary(std::unique_ptr<Impl> impl) : impl_(std::move(impl)) {}
AssetLibrary::AssetLibrary(AssetLibrary&&) noexcept = default;
AssetLibrary::~AssetLibrary() = default;

std::vector<std::string> AssetLibrary::defaultFolders() {
  return {"/usr/share/sweethome3d", "/usr/local/share/sweethome3d"};
}

namespace {

/// Catalogues and jars in the folders, sorted by file name; of one name the first counts.
std::map<std::string, fs::path> catalogueFiles(const std::vector<std::string>& folders) {
  std::map<std::string, fs::path> files;
  for (const fs::path folder : folders) {
    for (const fs::path& place : {folder, folder / "furniture"}) {
      std::error_code failure;
      for (const auto& file : fs::directory_iterator(place, failure)) {
        const std::string name = file.path().filename().string();
        if (file.path().extension() == ".sh3f" || lowerCase(name) == kJarName)
          files.emplace(name, file.path());
      }
    }
  }
  return files;
}

}  // namespace

bool AssetLibrary::isInstalled() {
  const std::map<std::string, fs::path> files = catalogueFiles(defaultFolders());
  const bool has_jar = std::any_of(files.begin(), files.end(),
                                   [](const auto& f) { return lowerCase(f.first) == kJarName; });
  return has_jar && std::all_of(kCatalogueNames.begin(), kCatalogueNames.end(),
                                [&](const char* name) { return files.count(name) > 0; });
}

AssetLibrary AssetLibrary::open(const std::vector<std::string>& folders) {
  const std::map<std::string, fs::path> files = catalogueFiles(folders);
  require(!files.empty(), "openAssets: expected furniture catalogues (*.sh3f) or ", kJarName,
          ", found none: install Debian's sweethome3d and sweethome3d-furniture");
  auto impl = std::make_unique<Impl>();
  for (const auto& [name, path] : files) {
    impl->zips.push_back(std::make_unique<CatalogueZip>(path.string()));
    const CatalogueZip& zip = *impl->zips.back();
    if (path.extension() == ".sh3f") {
      impl->addModels(zip, "PluginFurnitureCatalog.properties", path.stem().string());
      continue;
    }
    impl->jar = &zip;
    impl->addModels(zip, joinText(kJarFolder, "DefaultFurnitureCatalog.properties"), "default");
    impl->addTextures(zip, joinText(kJarFolder, "DefaultTexturesCatalog.properties"));
  }
  impl->applyTable(readTable(VDBC_ROOMS_DIR "/models.tsv"));
  return AssetLibrary(std::move(impl));
}

const std::vector<ModelInfo>& AssetLibrary::models() const { return impl_->models; }

size_t AssetLibrary::find(const std::string& id) const {
  const auto found = impl_->by_id.find(id);
  require(found != impl_->by_id.end(), "findModel: expected the id of an installed model, found \"",
          id, "\"");
  return found->second;
}

std::vector<size_t> AssetLibrary::withRole(const std::string& role, bool held_out) const {
  std::vector<size_t> found;
  for (const auto& [id, i] : impl_->by_id) {
    const ModelInfo& model = impl_->models[i];
    if (model.role == role && model.is_held_out == held_out && model.fault.empty())
      found.push_back(i);
  }
  return found;
}

std::shared_ptr<const SurfaceMesh> AssetLibrary::mesh(size_t model) const {
  require(model < impl_->models.size(), "readModel: expected an index below ", impl_->models.size(),
          ", found ", model);
  return impl_->readMesh(model);
}

const std::vector<TextureInfo>& AssetLibrary::textures() const { return impl_->textures; }

std::shared_ptr<const Texture> AssetLibrary::texture(size_t index) const {
  require(index < impl_->textures.size(), "readTexture: expected an index below ",
          impl_->textures.size(), ", found ", index);
  const TextureSource& source = impl_->texture_sources[index];
  return impl_->image(*source.zip, source.image);
}

std::vector<std::string> AssetLibrary::jarFiles(const std::string& prefix) const {
  require(impl_->jar != nullptr, "readJar: expected ", kJarName,
          ", found none: install sweethome3d");
  std::vector<std::string> names;
  const auto& entries = impl_->jar->entries();
  for (auto e = entries.lower_bound(prefix); e != entries.end(); ++e) {
    if (e->first.compare(0, prefix.size(), prefix) != 0) break;
    names.push_back(e->first);
  }
  return names;
}

std::string AssetLibrary::jarFile(const std::string& name) const {
  require(impl_->jar != nullptr, "readJar: expected ", kJarName,
          ", found none: install sweethome3d");
  return impl_->jar->read(name);
}

std::string modelFault(const AssetLibrary& assets, size_t model, std::string* note) {
  try {
    // mesh() hands out nothing else.
    const auto mesh = std::static_pointer_cast<const ReadMesh>(assets.mesh(model));
    if (note) *note = mesh->note;
    return mesh->fault;
  } catch (const Error& error) {
    // The reason alone: where catalogues lie differs between machines.
    const std::string what = error.what();
    const size_t colon = what.rfind(": ");
    return colon == std::string::npos ? what : what.substr(colon + 2);
  }
}

// ---- models.tsv and attribution

namespace {

/// Held out are all of KatorLegaz, and of each role's other models a random 15 %, but at least so
/// many that both sides have some: two of the role in all where it has enough.
std::set<std::string> heldOutModels(
    const std::map<std::string, std::vector<const ModelInfo*>>& roles) {
  std::set<std::string> held_out;
  for (const auto& [role, members] : roles) {
    std::vector<std::string> others;
    int held = 0;
    for (const ModelInfo* model : members) {
      if (model->catalogue == "KatorLegaz")
        held_out.insert(model->id), ++held;
      else
        others.push_back(model->id);
    }
    std::sort(others.begin(), others.end());
    uint64_t seed = 14695981039346656037u;  // FNV-1a
    for (char c : role) seed = (seed ^ uint8_t(c)) * 1099511628211u;
    std::mt19937_64 random(seed);
    for (size_t i = others.size(); i > 1; --i) std::swap(others[i - 1], others[random() % i]);
    const int count = int(others.size());
    const int least = held == 0 ? std::min(2, (count + 1) / 3) : std::min(2 - held, count / 4);
    held_out.insert(others.begin(), others.begin() + std::max((15 * count + 50) / 100, least));
  }
  return held_out;
}

}  // namespace

std::string modelTable(const AssetLibrary& assets) {
  std::vector<std::string> faults;
  std::map<std::string, std::vector<const ModelInfo*>> roles;
  std::map<std::string, size_t> sorted;
  for (size_t i = 0; i < assets.models().size(); ++i) {
    const ModelInfo& model = assets.models()[i];
    faults.push_back(modelFault(assets, i, nullptr));
    sorted.emplace(model.id, i);
    if (faults[i].empty() && model.role != "none") roles[model.role].push_back(&model);
  }
  const std::set<std::string> held_out = heldOutModels(roles);
  std::ostringstream out;
  out << "# Models of sweethome3d and sweethome3d-furniture: id, split, role in a room, fault.\n"
         "# Roles are set by hand; split and fault are written by modelTable (assets.cpp): of what "
         "has\n"
         "# a role and no fault, all of KatorLegaz and a random 15 % of the rest of each role are "
         "held\n"
         "# out of training.\n";
  for (const auto& [id, i] : sorted) {
    const bool is_used = faults[i].empty() && assets.models()[i].role != "none";
    out << id << '\t' << (is_used ? held_out.count(id) ? "held-out" : "train" : "-") << '\t'
        << assets.models()[i].role << '\t' << faults[i] << '\n';
  }
  return out.str();
}

std::string attribution(const AssetLibrary& assets) {
  std::map<std::string, std::map<std::string, const ModelInfo*>> catalogues;
  for (const ModelInfo& model : assets.models())
    if (model.fault.empty() && model.role != "none") catalogues[model.catalogue][model.id] = &model;
  std::ostringstream out;
  for (const auto& [catalogue, members] : catalogues) {
    out << "## " << catalogue << "\n\n";
    for (const auto& [id, model] : members)
      out << "- " << model->name << " (" << id << "), " << model->creator << ", " << model->licence
          << '\n';
    out << '\n';
  }
  if (!assets.textures().empty()) {
    out << "## Textures of the default catalogue\n\n";
    for (const TextureInfo& texture : assets.textures())
      out << "- " << texture.name << " (" << texture.id << "), eTeks, GNU GPL / CC-BY 3.0\n";
  }
  return out.str();
}

}  // namespace vdbc
