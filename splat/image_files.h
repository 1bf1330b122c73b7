#pragma once
// Pictures from PNG and JPEG, in files or in memory, and to PNG.
#include <cstdint>
#include <string>
#include <vector>

#include "splat/image.h"

namespace vdbc {

/// 8- or 16-bit PNG or 8-bit JPEG as values 0-1 (no transfer applied): 1, 3 channels (alpha
/// dropped). Throws Error, opened by `operation` and `name`, on corrupt or oversized pictures (more
/// than 2^28 pixels).
Image decodeImage(const char* operation, const std::string& name, const void* bytes, size_t size);
/// The same as 8-bit samples with alpha (255 where the picture has none): [height, width, 4].
std::vector<uint8_t> decodeRgba(const char* operation, const std::string& name, const void* bytes,
                                size_t size, int* width, int* height);

/// decodeImage() of a file. Throws Error also where it is missing.
Image readImage(const std::string& path);
/// 16-bit greyscale PNG as raw integers (depth in millimetres, say): [height, width]. Throws Error.
std::vector<uint16_t> readPng16(const std::string& path, int* width, int* height);
/// Clamps to 0-1 and rounds to 8 bits; 1 or 3 channels. Temporary name, then rename. Throws Error.
void writePng(const Image& image, const std::string& path);
/// 16-bit greyscale PNG of raw integers, [height * width].
void writePng16(const std::vector<uint16_t>& data, int width, int height, const std::string& path);

}  // namespace vdbc
