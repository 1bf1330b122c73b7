#include "splat/ply.h"

#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cmath>
#include <cstring>
#include <limits>
#include <sstream>

#include "splat/gaussian_files.h"
#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

constexpr float kMaxLogit = 15.f;  // 3DGS tools take the sigmoid in float
constexpr size_t kMaxPlyHeaderBytes = 128 << 10;

struct PlyProperty {
  std::string name, type;
  size_t offset = 0;  // bytes into the row
};

struct PlyElement {
  std::string name;
  uint64_t count = 0;
  size_t row_bytes = 0;
  std::vector<PlyProperty> properties;
};

struct PlyHeader {
  std::vector<PlyElement> elements;
  bool antialias = false;
  size_t bytes = 0;
};

size_t plyTypeBytes(const std::string& type) {
  for (const auto& [names, size] :
       {std::pair<std::array<const char*, 4>, size_t>{{"char", "uchar", "int8", "uint8"}, 1},
        {{"short", "ushort", "int16", "uint16"}, 2},
        {{"int", "uint", "int32", "uint32"}, 4},
        {{"float", "float32", "float", "float32"}, 4},
        {{"double", "float64", "double", "float64"}, 8}}) {
    for (const char* name : names) {
      if (type == name) return size;
    }
  }
  return 0;
}

/// Adds what a line `element NAME COUNT` says.
void addElement(const std::string& line, const std::string& prefix, PlyHeader* header) {
  std::istringstream words(line);
  PlyElement element;
  std::string keyword, count;
  words >> keyword >> element.name >> count;
  const char* end = count.data() + count.size();
  const auto [stop, failure] = std::from_chars(count.data(), end, element.count);
  require(!element.name.empty() && failure == std::errc() && stop == end, prefix,
          "expected `element NAME COUNT`, found `", line, "`");
  header->elements.push_back(element);
}

/// Adds what a line `property TYPE NAME` says to the last element.
void addProperty(const std::string& line, const std::string& prefix, PlyHeader* header) {
  std::istringstream words(line);
  std::string keyword, type, name, extra;
  words >> keyword >> type >> name >> extra;
  require(type != "list", prefix, "list properties are not supported (found `", line, "`)");
  const size_t size = plyTypeBytes(type);
  require(!header->elements.empty() && size > 0 && !name.empty() && extra.empty(), prefix,
          "expected `property TYPE NAME` of an element, found `", line, "`");
  PlyElement& element = header->elements.back();
  for (const PlyProperty& other : element.properties)
    require(other.name != name, prefix, "property ", name, " is there twice");
  element.properties.push_back({name, type, element.row_bytes});
  element.row_bytes += size;
}

PlyHeader parsePlyHeader(const std::vector<uint8_t>& bytes, const std::string& path) {
  const std::string prefix = "readPly: " + path + ": ";
  const auto* begin = reinterpret_cast<const char*>(bytes.data());
  const std::string_view text(begin, std::min(bytes.size(), kMaxPlyHeaderBytes));
  PlyHeader header;
  bool format_seen = false;
  for (size_t line_number = 0;; ++line_number) {
    const size_t end = text.find('\n', header.bytes);
    require(line_number > 0 || text.substr(0, 3) == "ply", prefix, "not a PLY file");
    require(end != std::string_view::npos, prefix, "the header has no end_header line");
    std::string line(text.substr(header.bytes, end - header.bytes));
    header.bytes = end + 1;
    if (!line.empty() && line.back() == '\r') line.pop_back();
    std::istringstream words(line);
    std::string keyword, first, second;
    words >> keyword >> first >> second;
    if (line_number == 0) {
      require(line == "ply", prefix, "not a PLY file");
    } else if (keyword == "comment") {
      if (first == "SplatRenderMode:") header.antialias = second == kAntialiasedMode;
      if (first == "antialiased") header.antialias = second == "1";
    } else if (keyword == "obj_info" || keyword.empty()) {
      continue;
    } else if (keyword == "format") {
      require(first == "binary_little_endian" && second == "1.0", prefix,
              "expected format binary_little_endian 1.0, found ", first, " ", second);
      format_seen = true;
    } else if (keyword == "element") {
      addElement(line, prefix, &header);
    } else if (keyword == "property") {
      addProperty(line, prefix, &header);
    } else if (keyword == "end_header") {
      require(format_seen, prefix, "the header has no format line");
      return header;
    } else {
      throw Error(prefix + "unknown header line `" + line + "`");
    }
  }
}

/// Offset and type of the splat's values in a row of the vertex element.
struct PlyLayout {
  struct Field {
    size_t offset = 0;
    bool is_double = false;
    float read(const uint8_t* row) const {
      if (is_double) {
        double value;
        std::memcpy(&value, row + offset, sizeof(value));
        return float(value);
      }
      float value;
      std::memcpy(&value, row + offset, sizeof(value));
      return value;
    }
  };
  std::array<Field, 3> mean, f_dc, scale;
  std::array<Field, 4> rotation;
  Field opacity;
  std::vector<Field> f_rest;  // channel-major
  int sh_degree = 0;
};

PlyLayout plyLayout(const PlyElement& vertex, const std::string& path) {
  const auto has = [&](const std::string& name) {
    return std::any_of(vertex.properties.begin(), vertex.properties.end(),
                       [&](const PlyProperty& p) { return p.name == name; });
  };
  const auto field = [&](const std::string& name) {
    for (const PlyProperty& p : vertex.properties) {
      if (p.name != name) continue;
      const bool is_float = p.type == "float" || p.type == "float32";
      const bool is_double = p.type == "double" || p.type == "float64";
      require(is_float || is_double, "readPly: ", path, ": property ", name,
              ": expected float, found ", p.type);
      return PlyLayout::Field{p.offset, is_double};
    }
    throw Error(joinText("readPly: ", path, ": not a Gaussian splat: no property ", name,
                         " (expected x y z f_dc_0-2 opacity scale_0-2 rot_0-3)"));
  };
  PlyLayout layout;
  layout.mean = {field("x"), field("y"), field("z")};
  layout.f_dc = {field("f_dc_0"), field("f_dc_1"), field("f_dc_2")};
  layout.opacity = field("opacity");
  layout.scale = {field("scale_0"), field("scale_1"), field("scale_2")};
  layout.rotation = {field("rot_0"), field("rot_1"), field("rot_2"), field("rot_3")};
  size_t rest = 0;
  while (has("f_rest_" + std::to_string(rest))) {
    layout.f_rest.push_back(field("f_rest_" + std::to_string(rest++)));
  }
  const size_t named =
      size_t(std::count_if(vertex.properties.begin(), vertex.properties.end(),
                           [](const PlyProperty& p) { return p.name.rfind("f_rest_", 0) == 0; }));
  const std::array<size_t, 4> counts = {0, 9, 24, 45};
  const auto degree = std::find(counts.begin(), counts.end(), rest);
  require(degree != counts.end() && named == rest, "readPly: ", path,
          ": expected 0, 9, 24 or 45 properties f_rest_0, f_rest_1, ..., found ", named);
  layout.sh_degree = int(degree - counts.begin());
  return layout;
}

}  // namespace

void writePly(const Gaussians& g, const std::string& path, const Eigen::Vector3f& up) {
  requireConsistent(g);
  const std::vector<int64_t> rows = writableRows(g);
  const size_t coefficients = size_t(g.shCoefficients()), rest = coefficients - 1;
  std::ostringstream header;
  header << "ply\nformat binary_little_endian 1.0\ncomment Generated by vdb_complete\n"
         << "comment SplatRenderMode: " << renderMode(g) << '\n';
  if (!up.isZero()) {
    header << "comment Vertical axis: " << up.x() << ' ' << up.y() << ' ' << up.z() << '\n';
  }
  header << "element vertex " << rows.size() << '\n';
  const auto property = [&](const std::string& name) {
    header << "property float " << name << '\n';
  };
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz"}) property(name);
  for (int i = 0; i < 3; ++i) property("f_dc_" + std::to_string(i));
  for (size_t i = 0; i < 3 * rest; ++i) property("f_rest_" + std::to_string(i));
  property("opacity");
  for (int i = 0; i < 3; ++i) property("scale_" + std::to_string(i));
  for (int i = 0; i < 4; ++i) property("rot_" + std::to_string(i));
  header << "end_header\n";

  static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "floats are copied as they are");
  const std::string text = header.str();
  const size_t row_floats = 6 + 3 * coefficients + 1 + 3 + 4;
  std::vector<char> bytes(text.size() + rows.size() * row_floats * sizeof(float));
  std::copy(text.begin(), text.end(), bytes.begin());
  tbb::parallel_for(size_t(0), rows.size(), [&](size_t i) {
    const size_t row = size_t(rows[i]);
    std::array<float, 62> values{};
    float* to = values.data();
    const Eigen::Vector3f p = worldMean(g, row);
    for (int k = 0; k < 3; ++k) *to++ = p[k];
    to += 3;  // normals stay 0
    const float* sh = g.sh.data() + row * coefficients * 3;
    for (size_t c = 0; c < 3; ++c) *to++ = sh[c];
    for (size_t c = 0; c < 3; ++c) {
      for (size_t k = 1; k <= rest; ++k) *to++ = sh[3 * k + c];
    }
    *to++ = std::clamp(g.opacity_logit[row], -kMaxLogit, kMaxLogit);
    for (int k = 0; k < 3; ++k) *to++ = g.log_scale[row][k];
    const Eigen::Vector4f q = unitRotation(g.rotation[row]);
    for (int k = 0; k < 4; ++k) *to++ = q[k];
    std::memcpy(bytes.data() + text.size() + i * row_floats * sizeof(float), values.data(),
                row_floats * sizeof(float));
  });
  writeFile("writePly", path, bytes.data(), bytes.size());
}

double plyStep(const Gaussians& g) {
  float farthest = 0;
  for (size_t i = 0; i < size_t(g.size()); ++i) {
    const float far = worldMean(g, i).cwiseAbs().maxCoeff();
    if (std::isfinite(far)) farthest = std::max(farthest, far);
  }
  return double(std::nextafter(farthest, std::numeric_limits<float>::infinity())) -
         double(farthest);
}

Gaussians readPly(const std::string& path) {
  const std::vector<uint8_t> bytes = readFile("readPly", path, kMaxGaussianBytes);
  const PlyHeader header = parsePlyHeader(bytes, path);
  size_t offset = header.bytes;
  const PlyElement* vertex = nullptr;
  for (const PlyElement& element : header.elements) {
    const bool compressed =
        element.name == "chunk" ||
        std::any_of(element.properties.begin(), element.properties.end(),
                    [](const PlyProperty& p) { return p.name == "packed_position"; });
    require(!compressed, "readPly: ", path,
            ": compressed PLY is not supported (expected float properties x y z f_dc_0 ...): "
            "convert it with splat-transform");
    const uint64_t available = bytes.size() - offset;
    require(element.row_bytes == 0 || element.count <= available / element.row_bytes,
            "readPly: ", path, ": truncated: expected ", element.count, " rows of ",
            element.row_bytes, " bytes in element ", element.name, ", found ", available, " bytes");
    if (element.name == "vertex") {
      vertex = &element;
      break;
    }
    offset += size_t(element.count) * element.row_bytes;
  }
  require(vertex, "readPly: ", path, ": not a Gaussian splat: no element vertex");
  const PlyLayout layout = plyLayout(*vertex, path);

  Gaussians g;
  g.resize(int64_t(vertex->count), layout.sh_degree);
  g.antialias = header.antialias;
  const size_t coefficients = size_t(g.shCoefficients()), rest = coefficients - 1;
  tbb::parallel_for(size_t(0), size_t(vertex->count), [&](size_t i) {
    const uint8_t* row = bytes.data() + offset + i * vertex->row_bytes;
    float* sh = g.sh.data() + i * coefficients * 3;
    for (size_t c = 0; c < 3; ++c) {
      g.mean[i][Eigen::Index(c)] = layout.mean[c].read(row);
      g.log_scale[i][Eigen::Index(c)] = layout.scale[c].read(row);
      sh[c] = layout.f_dc[c].read(row);
      for (size_t k = 0; k < rest; ++k) sh[3 * (k + 1) + c] = layout.f_rest[c * rest + k].read(row);
    }
    for (size_t k = 0; k < 4; ++k) g.rotation[i][Eigen::Index(k)] = layout.rotation[k].read(row);
    g.opacity_logit[i] = layout.opacity.read(row);
  });
  const std::vector<int64_t> rows = finiteRows(g);
  if (int64_t(rows.size()) == g.size()) return g;
  return selectRows(std::move(g), rows);
}

}  // namespace vdbc
