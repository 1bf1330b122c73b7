#include "houdini_style_tools/report.h"

#include <algorithm>
#include <cstdio>
#include <nlohmann/json.hpp>

namespace vdbc {

void printResult(bool json, const nlohmann::ordered_json& result, const std::string& text) {
  std::printf("%s\n", json ? result.dump().c_str() : text.c_str());
  std::fflush(stdout);
}

void printValues(bool json, const nlohmann::ordered_json& values) {
  if (json) return printResult(json, values, "");
  size_t width = 0;
  for (const auto& [key, value] : values.items()) width = std::max(width, key.size());
  for (const auto& [key, value] : values.items())
    std::printf("%-*s %s\n", int(width), key.c_str(),
                value.is_string() ? value.get<std::string>().c_str() : value.dump().c_str());
}

}  // namespace vdbc
