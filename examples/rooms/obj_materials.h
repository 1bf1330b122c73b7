#pragma once
// Private to assets: materials of OBJ files.
#include <tiny_obj_loader.h>

#include <map>
#include <string>
#include <vector>

#include "examples/rooms/catalogue.h"

namespace vdbc {

constexpr float kMaxReflectance = .85f;  // fresh snow; brighter surfaces would glow

/// Finds material files in the catalogue. LoadObj only asks for what an OBJ names, so that one
/// without a file is given the line "mtllib", whose empty name nothing has.
class CatalogueMaterials : public tinyobj::MaterialReader {
 public:
  CatalogueMaterials(const CatalogueZip& zip, std::string obj) : zip_(zip), obj_(std::move(obj)) {}

  bool operator()(const std::string& name, std::vector<tinyobj::material_t>* materials,
                  std::map<std::string, int>* ids, std::string* warn, std::string* error) override;

 private:
  const CatalogueZip& zip_;
  std::string obj_;
};

/// Factor of a texture: exporters' greys and black mean no tint.
Eigen::Vector3f textureFactor(const tinyobj::real_t (&kd)[3]);
/// Material without its texture.
Material plainMaterial(const tinyobj::material_t& m, bool has_lights);

}  // namespace vdbc
