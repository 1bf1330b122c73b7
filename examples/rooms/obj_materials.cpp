#include "examples/rooms/obj_materials.h"

#include <algorithm>
#include <cmath>
#include <filesystem>
#include <sstream>

#include "splat/image.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;
using Eigen::Vector3f;

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

}  // namespace

bool CatalogueMaterials::operator()(const std::string& name,
                                    std::vector<tinyobj::material_t>* materials,
                                    std::map<std::string, int>* ids, std::string* warn,
                                    std::string* error) {
  const std::string folder = obj_.substr(0, obj_.size() - baseName(obj_).size());
  std::string entry = zip_.locate(folder, name);
  if (entry.empty()) entry = zip_.locate(folder, fs::path(baseName(obj_)).stem().string() + ".mtl");
  if (!entry.empty()) {
    std::istringstream file(zip_.read(entry));
    tinyobj::LoadMtl(ids, materials, &file, warn, error);
  }
  std::istringstream named(namedColoursMtl());
  tinyobj::LoadMtl(ids, materials, &named, warn, error);  // does not replace what is there
  return true;
}

Vector3f textureFactor(const tinyobj::real_t (&kd)[3]) {
  const float low = std::min({kd[0], kd[1], kd[2]}), high = largest(kd);
  const bool is_neutral = high - low < .02f && (high < .02f || high >= .3f);
  return is_neutral ? Vector3f::Constant(kMaxReflectance) : linearColour(kd);
}

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

}  // namespace vdbc
