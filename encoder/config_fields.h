#pragma once
// Private: the configurations that weights carry, as JSON. A Config lists its fields once:
// `Config::fields(c, visit)` calls visit(name, field) for each.
#include <nlohmann/json.hpp>
#include <string>

#include "vdb/error.h"

namespace vdbc {

template <typename Config>
std::string configJson(const Config& config) {
  nlohmann::json j;
  Config::fields(config, [&](const char* name, const auto& value) { j[name] = value; });
  return j.dump();
}

/// Fields that the text lacks keep their defaults: weights from before a field existed go on
/// meaning what they meant. Throws Error, with `operation` and `where` before the message, for text
/// that is no object, fields that nobody knows and values of other types.
template <typename Config>
Config configFromJson(const char* operation, const std::string& text, const std::string& where) {
  Config config;
  try {
    nlohmann::json j = nlohmann::json::parse(text);
    Config::fields(config, [&](const char* name, auto& value) {
      const auto found = j.find(name);
      if (found == j.end()) return;
      found->get_to(value);
      j.erase(found);
    });
    require(j.is_object() && j.empty(), operation, ": ", where,
            ": bad configuration: unknown fields ", j.dump());
  } catch (const nlohmann::json::exception& e) {
    throw Error(joinText(operation, ": ", where, ": bad configuration: ", e.what()));
  }
  return config;
}

}  // namespace vdbc
