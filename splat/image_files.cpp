#include "splat/image_files.h"

#include <jpeglib.h>
// jerror.h needs jpeglib.h before it.
#include <jerror.h>
#include <png.h>

#include <algorithm>
#include <array>
#include <csetjmp>
#include <cstdio>
#include <cstring>

#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

// No deflate stream expands more than 1032-fold (zlib's technical notes), and a Huffman-coded JPEG
// spends at least one bit on each 8 x 8 block of each component (at most 4 x 4 pixels of luminance
// per chroma block): a header that promises more than this lies, and no memory is taken for it.
constexpr uint64_t kMaxPngExpansion = 1040;
constexpr uint64_t kMaxJpegPixelsPerByte = 8 * 64;

/// Decoded samples as stored, interleaved; 16-bit samples are in native byte order.
struct Samples {
  int width = 0, height = 0, channels = 0, bits = 0;
  std::vector<uint8_t> bytes;

  size_t rowBytes() const { return size_t(width) * size_t(channels) * size_t(bits / 8); }
};

/// A file in memory, and how to complain about it.
struct Encoded {
  const char* operation;
  const std::string& name;
  const uint8_t* bytes;
  size_t size;

  template <typename... Parts>
  void require(bool condition, const Parts&... parts) const {
    vdbc::require(condition, operation, ": ", name, ": ", parts...);
  }
  bool startsWith(std::initializer_list<uint8_t> magic) const {
    return size >= magic.size() && std::equal(magic.begin(), magic.end(), bytes);
  }
  bool isPng() const { return startsWith({0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n'}); }
};

/// What samples to make of a file: 1 or 3 channels of 8 or 16 bits as they are stored, without
/// alpha; 16-bit grey and nothing else; or 8-bit RGBA.
enum class Want { kColour, kGrey16, kRgba8 };

// ---- PNG. libpng reports errors by longjmp: the functions between setjmp and longjmp hold nothing
// with a destructor.

struct PngSource {
  const uint8_t* bytes;
  size_t size, position;
  char message[200];
};

void onPngError(png_structp png, png_const_charp message) {
  char* text = static_cast<char*>(png_get_error_ptr(png));
  std::snprintf(text, sizeof(PngSource::message), "%s", message);
  longjmp(png_jmpbuf(png), 1);
}

void onPngWarning(png_structp, png_const_charp) {}

void readPngBytes(png_structp png, png_bytep to, size_t count) {
  auto* source = static_cast<PngSource*>(png_get_io_ptr(png));
  if (count > source->size - source->position) png_error(png, "file ends early");
  std::memcpy(to, source->bytes + source->position, count);
  source->position += count;
}

/// Reads up to the first row; false with source->message set on failure.
bool startPng(png_structp png, png_infop info, PngSource* source, Want want, Samples* image,
              bool* grey16) {
  if (setjmp(png_jmpbuf(png))) return false;
  png_set_read_fn(png, source, readPngBytes);
  png_read_info(png, info);
  png_uint_32 width = 0, height = 0;
  int bits = 0, type = 0;
  png_get_IHDR(png, info, &width, &height, &bits, &type, nullptr, nullptr, nullptr);
  *grey16 = type == PNG_COLOR_TYPE_GRAY && bits == 16;
  if (uint64_t(width) * height > kMaxImagePixels) png_error(png, "more than 2^28 pixels");
  if (want == Want::kRgba8) {
    png_set_expand(png);
    png_set_scale_16(png);
    png_set_gray_to_rgb(png);
    png_set_add_alpha(png, 0xff, PNG_FILLER_AFTER);
  } else {
    if (type == PNG_COLOR_TYPE_PALETTE) png_set_palette_to_rgb(png);
    if (type == PNG_COLOR_TYPE_GRAY && bits < 8) png_set_expand_gray_1_2_4_to_8(png);
    if (type & PNG_COLOR_MASK_ALPHA) png_set_strip_alpha(png);
    if (bits == 16) png_set_swap(png);  // PNG is big endian
  }
  png_set_interlace_handling(png);
  png_read_update_info(png, info);
  image->width = int(width), image->height = int(height);
  image->channels = png_get_channels(png, info);
  image->bits = png_get_bit_depth(png, info);
  if (png_get_rowbytes(png, info) != image->rowBytes()) png_error(png, "unknown sample layout");
  // The packed rows that are in the file, which for palettes and 1-bit grey are smaller than ours.
  const uint64_t packed = uint64_t(height) * ((uint64_t(width) * uint64_t(bits) + 7) / 8);
  if (packed / kMaxPngExpansion > source->size) png_error(png, "file is too short for its size");
  return true;
}

bool finishPng(png_structp png, PngSource*, uint8_t** rows) {
  if (setjmp(png_jmpbuf(png))) return false;
  png_read_image(png, rows);
  png_read_end(png, nullptr);
  return true;
}

Samples decodePng(const Encoded& from, Want want) {
  struct Handles {
    PngSource source;
    png_structp png = nullptr;
    png_infop info = nullptr;
    ~Handles() { png_destroy_read_struct(&png, &info, nullptr); }
  } h;
  h.source = {from.bytes, from.size, 0, ""};
  h.png = png_create_read_struct(PNG_LIBPNG_VER_STRING, h.source.message, onPngError, onPngWarning);
  if (h.png) h.info = png_create_info_struct(h.png);
  from.require(h.png && h.info, "libpng cannot start");
  Samples image;
  bool grey16 = false;
  from.require(startPng(h.png, h.info, &h.source, want, &image, &grey16),
               "corrupt PNG: ", h.source.message);
  from.require(want != Want::kGrey16 || grey16, "expected a 16-bit greyscale PNG, found ",
               image.bits, " bits and ", image.channels, " channels");
  image.bytes.resize(image.rowBytes() * size_t(image.height));
  std::vector<uint8_t*> rows(size_t(image.height));
  for (size_t y = 0; y < rows.size(); ++y) rows[y] = image.bytes.data() + y * image.rowBytes();
  from.require(finishPng(h.png, &h.source, rows.data()), "corrupt PNG: ", h.source.message);
  return image;
}

bool encodePng(png_structp png, png_infop info, std::FILE* file, const Samples& image,
               uint8_t** rows) {
  if (setjmp(png_jmpbuf(png))) return false;
  png_init_io(png, file);
  png_set_compression_level(png, 4);  // within a few per cent of 6 in size, twice as fast
  png_set_IHDR(png, info, png_uint_32(image.width), png_uint_32(image.height), image.bits,
               image.channels == 1 ? PNG_COLOR_TYPE_GRAY : PNG_COLOR_TYPE_RGB, PNG_INTERLACE_NONE,
               PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
  png_write_info(png, info);
  if (image.bits == 16) png_set_swap(png);
  png_write_image(png, rows);
  png_write_end(png, info);
  return true;
}

void savePng(const char* operation, const Samples& image, const std::string& path) {
  struct Handles {
    char message[sizeof(PngSource::message)] = "";
    png_structp png = nullptr;
    png_infop info = nullptr;
    std::FILE* file = nullptr;
    ~Handles() {
      png_destroy_write_struct(&png, &info);
      if (file) std::fclose(file);
    }
  } h;
  TemporaryFile temporary(operation, path);
  h.file = std::fopen(temporary.path().c_str(), "wb");
  require(h.file, operation, ": ", path, ": cannot create (is the folder there and writable?)");
  h.png = png_create_write_struct(PNG_LIBPNG_VER_STRING, h.message, onPngError, onPngWarning);
  if (h.png) h.info = png_create_info_struct(h.png);
  require(h.png && h.info, operation, ": ", path, ": libpng cannot start");
  std::vector<uint8_t*> rows(size_t(image.height));
  for (size_t y = 0; y < rows.size(); ++y) {
    rows[y] = const_cast<uint8_t*>(image.bytes.data()) + y * image.rowBytes();
  }
  require(encodePng(h.png, h.info, h.file, image, rows.data()), operation, ": ", path, ": ",
          h.message);
  std::FILE* file = h.file;
  h.file = nullptr;
  require(std::fclose(file) == 0, operation, ": ", path, ": cannot write (is the disk full?)");
  temporary.commit();
}

// ---- JPEG. Same rule: nothing with a destructor between setjmp and longjmp.

struct JpegErrors {
  jpeg_error_mgr base;  // first: libjpeg hands back a pointer to it
  std::jmp_buf jump;
  char message[JMSG_LENGTH_MAX];
};

[[noreturn]] void onJpegError(j_common_ptr jpeg) {
  auto* errors = reinterpret_cast<JpegErrors*>(jpeg->err);
  jpeg->err->format_message(jpeg, errors->message);
  std::longjmp(errors->jump, 1);
}

void onJpegMessage(j_common_ptr jpeg, int level) {
  // libjpeg paints what is missing grey and goes on: to us a damaged picture is an error.
  if (level < 0 && jpeg->err->msg_code != JWRN_EXTRANEOUS_DATA) onJpegError(jpeg);
}

bool startJpeg(jpeg_decompress_struct* jpeg, JpegErrors* errors, const Encoded& from) {
  if (setjmp(errors->jump)) return false;
  jpeg_create_decompress(jpeg);
  jpeg_mem_src(jpeg, from.bytes, static_cast<unsigned long>(from.size));
  jpeg_read_header(jpeg, TRUE);
  return true;
}

bool finishJpeg(jpeg_decompress_struct* jpeg, JpegErrors* errors, Samples* image) {
  if (setjmp(errors->jump)) return false;
  jpeg_start_decompress(jpeg);
  while (jpeg->output_scanline < jpeg->output_height) {
    JSAMPROW row = image->bytes.data() + size_t(jpeg->output_scanline) * image->rowBytes();
    jpeg_read_scanlines(jpeg, &row, 1);
  }
  jpeg_finish_decompress(jpeg);
  return true;
}

Samples decodeJpeg(const Encoded& from, Want want) {
  struct Handles {
    jpeg_decompress_struct jpeg{};
    JpegErrors errors{};
    ~Handles() { jpeg_destroy_decompress(&jpeg); }
  } h;
  h.jpeg.err = jpeg_std_error(&h.errors.base);
  h.errors.base.error_exit = onJpegError;
  h.errors.base.emit_message = onJpegMessage;
  from.require(startJpeg(&h.jpeg, &h.errors, from), "corrupt JPEG: ", h.errors.message);
  const uint64_t pixels = uint64_t(h.jpeg.image_width) * h.jpeg.image_height;
  from.require(pixels <= kMaxImagePixels, "more than 2^28 pixels (", h.jpeg.image_width, " x ",
               h.jpeg.image_height, ")");
  from.require(pixels / kMaxJpegPixelsPerByte <= from.size, "corrupt JPEG: ", from.size,
               " bytes are too few for ", h.jpeg.image_width, " x ", h.jpeg.image_height,
               " pixels");
  const J_COLOR_SPACE space = h.jpeg.jpeg_color_space;
  from.require(space == JCS_GRAYSCALE || space == JCS_YCbCr || space == JCS_RGB,
               "expected a greyscale or RGB JPEG, found CMYK or another colour space");
  const bool is_grey = space == JCS_GRAYSCALE && want != Want::kRgba8;
  h.jpeg.out_color_space = is_grey ? JCS_GRAYSCALE : JCS_RGB;
  Samples image;
  image.width = int(h.jpeg.image_width), image.height = int(h.jpeg.image_height);
  image.channels = is_grey ? 1 : 3;
  image.bits = 8;
  image.bytes.resize(image.rowBytes() * size_t(image.height));
  from.require(finishJpeg(&h.jpeg, &h.errors, &image), "corrupt JPEG: ", h.errors.message);
  return image;
}

Samples decode(const Encoded& from, Want want) {
  from.require(from.size > 0, "file is empty");
  if (from.isPng()) return decodePng(from, want);
  from.require(want != Want::kGrey16, "expected a PNG file, found another format");
  from.require(from.startsWith({0xff, 0xd8, 0xff}),
               "expected a PNG or JPEG file, found another format");
  return decodeJpeg(from, want);
}

}  // namespace

Image decodeImage(const char* operation, const std::string& name, const void* bytes, size_t size) {
  const Encoded from{operation, name, static_cast<const uint8_t*>(bytes), size};
  const Samples raw = decode(from, Want::kColour);
  from.require(raw.channels == 1 || raw.channels == 3, "expected 1 or 3 channels, found ",
               raw.channels);
  Image image(raw.width, raw.height, raw.channels);
  const size_t n = image.data.size();
  if (raw.bits == 8) {
    std::array<float, 256> value;
    for (size_t i = 0; i < value.size(); ++i) value[i] = float(i) / 255.f;
    for (size_t i = 0; i < n; ++i) image.data[i] = value[raw.bytes[i]];
  } else {
    for (size_t i = 0; i < n; ++i) {
      uint16_t v;
      std::memcpy(&v, raw.bytes.data() + 2 * i, 2);
      image.data[i] = float(v) / 65535.f;
    }
  }
  return image;
}

std::vector<uint8_t> decodeRgba(const char* operation, const std::string& name, const void* bytes,
                                size_t size, int* width, int* height) {
  const Encoded from{operation, name, static_cast<const uint8_t*>(bytes), size};
  Samples raw = decode(from, Want::kRgba8);
  *width = raw.width, *height = raw.height;
  if (raw.channels == 4) return std::move(raw.bytes);
  const size_t pixels = size_t(raw.width) * size_t(raw.height);
  std::vector<uint8_t> rgba(4 * pixels, 0xff);
  for (size_t i = 0; i < pixels; ++i) std::copy_n(&raw.bytes[3 * i], 3, &rgba[4 * i]);
  return rgba;
}

Image readImage(const std::string& path) {
  constexpr const char* kOperation = "readImage";
  const std::vector<uint8_t> bytes = readFile(kOperation, path, kMaxImageBytes);
  return decodeImage(kOperation, path, bytes.data(), bytes.size());
}

std::vector<uint16_t> readPng16(const std::string& path, int* width, int* height) {
  constexpr const char* kOperation = "readPng16";
  const std::vector<uint8_t> bytes = readFile(kOperation, path, kMaxImageBytes);
  const Samples raw = decode({kOperation, path, bytes.data(), bytes.size()}, Want::kGrey16);
  *width = raw.width, *height = raw.height;
  std::vector<uint16_t> values(size_t(raw.width) * size_t(raw.height));
  std::memcpy(values.data(), raw.bytes.data(), raw.bytes.size());
  return values;
}

void writePng(const Image& image, const std::string& path) {
  constexpr const char* kOperation = "writePng";
  requireImage(kOperation, image);
  require(image.channels == 1 || image.channels == 3, kOperation, ": ", path,
          ": expected 1 or 3 channels, found ", image.channels);
  Samples raw{image.width, image.height, image.channels, 8, {}};
  raw.bytes.resize(image.data.size());
  for (size_t i = 0; i < image.data.size(); ++i) {
    const float v = image.data[i];
    raw.bytes[i] = v > 0 ? uint8_t(std::min(v, 1.f) * 255.f + 0.5f) : uint8_t(0);  // NaN: 0
  }
  savePng(kOperation, raw, path);
}

void writePng16(const std::vector<uint16_t>& data, int width, int height, const std::string& path) {
  constexpr const char* kOperation = "writePng16";
  require(width > 0 && height > 0 && data.size() == size_t(width) * size_t(height), kOperation,
          ": ", path, ": expected ", width, " x ", height, " values, found ", data.size());
  Samples raw{width, height, 1, 16, {}};
  raw.bytes.resize(data.size() * 2);
  std::memcpy(raw.bytes.data(), data.data(), raw.bytes.size());
  savePng(kOperation, raw, path);
}

}  // namespace vdbc
