#include "splat/image.h"

#include <jpeglib.h>
// jerror.h needs jpeglib.h before it.
#include <jerror.h>
#include <png.h>
#include <tbb/blocked_range.h>
#include <tbb/parallel_for.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <csetjmp>
#include <cstdio>
#include <cstring>
#include <limits>

#include "vdb/error.h"
#include "vdb/file_io.h"

namespace vdbc {
namespace {

constexpr uint64_t kMaxPixels = uint64_t(1) << 28;
constexpr uint64_t kMaxFileBytes = uint64_t(1) << 32;
// No deflate stream expands more than 1032-fold (zlib's technical notes), and a Huffman-coded JPEG
// spends at least one bit on each 8 x 8 block of each component (at most 4 x 4 pixels of luminance
// per chroma block): a header that promises more than this lies, and no memory is taken for it.
constexpr uint64_t kMaxPngExpansion = 1040;
constexpr uint64_t kMaxJpegPixelsPerByte = 8 * 64;

/// Decoded samples as stored, interleaved; 16-bit samples are in native byte order.
struct RawImage {
  int width = 0, height = 0, channels = 0, bits = 0;
  std::vector<uint8_t> bytes;

  size_t rowBytes() const { return size_t(width) * size_t(channels) * size_t(bits / 8); }
};

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
bool startPng(png_structp png, png_infop info, PngSource* source, RawImage* image, bool* grey16) {
  if (setjmp(png_jmpbuf(png))) return false;
  png_set_read_fn(png, source, readPngBytes);
  png_read_info(png, info);
  png_uint_32 width = 0, height = 0;
  int bits = 0, type = 0;
  png_get_IHDR(png, info, &width, &height, &bits, &type, nullptr, nullptr, nullptr);
  *grey16 = type == PNG_COLOR_TYPE_GRAY && bits == 16;
  if (uint64_t(width) * height > kMaxPixels) png_error(png, "more than 2^28 pixels");
  if (type == PNG_COLOR_TYPE_PALETTE) png_set_palette_to_rgb(png);
  if (type == PNG_COLOR_TYPE_GRAY && bits < 8) png_set_expand_gray_1_2_4_to_8(png);
  if (type & PNG_COLOR_MASK_ALPHA) png_set_strip_alpha(png);
  if (bits == 16) png_set_swap(png);  // PNG is big endian
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

RawImage decodePng(const char* operation, const std::string& path,
                   const std::vector<uint8_t>& bytes, bool only_grey16) {
  struct Handles {
    PngSource source;
    png_structp png = nullptr;
    png_infop info = nullptr;
    ~Handles() { png_destroy_read_struct(&png, &info, nullptr); }
  } h;
  h.source = {bytes.data(), bytes.size(), 0, ""};
  h.png = png_create_read_struct(PNG_LIBPNG_VER_STRING, h.source.message, onPngError, onPngWarning);
  if (h.png) h.info = png_create_info_struct(h.png);
  require(h.png && h.info, operation, ": ", path, ": libpng cannot start");
  RawImage image;
  bool grey16 = false;
  require(startPng(h.png, h.info, &h.source, &image, &grey16), operation, ": ", path,
          ": corrupt PNG: ", h.source.message);
  require(!only_grey16 || grey16, operation, ": ", path,
          ": expected a 16-bit greyscale PNG, found ", image.bits, " bits and ", image.channels,
          " channels");
  image.bytes.resize(image.rowBytes() * size_t(image.height));
  std::vector<uint8_t*> rows(size_t(image.height));
  for (size_t y = 0; y < rows.size(); ++y) rows[y] = image.bytes.data() + y * image.rowBytes();
  require(finishPng(h.png, &h.source, rows.data()), operation, ": ", path,
          ": corrupt PNG: ", h.source.message);
  return image;
}

bool encodePng(png_structp png, png_infop info, std::FILE* file, const RawImage& image,
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

void savePng(const char* operation, const RawImage& image, const std::string& path) {
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

bool startJpeg(jpeg_decompress_struct* jpeg, JpegErrors* errors,
               const std::vector<uint8_t>& bytes) {
  if (setjmp(errors->jump)) return false;
  jpeg_create_decompress(jpeg);
  jpeg_mem_src(jpeg, bytes.data(), static_cast<unsigned long>(bytes.size()));
  jpeg_read_header(jpeg, TRUE);
  return true;
}

bool finishJpeg(jpeg_decompress_struct* jpeg, JpegErrors* errors, RawImage* image) {
  if (setjmp(errors->jump)) return false;
  jpeg_start_decompress(jpeg);
  while (jpeg->output_scanline < jpeg->output_height) {
    JSAMPROW row = image->bytes.data() + size_t(jpeg->output_scanline) * image->rowBytes();
    jpeg_read_scanlines(jpeg, &row, 1);
  }
  jpeg_finish_decompress(jpeg);
  return true;
}

RawImage decodeJpeg(const char* operation, const std::string& path,
                    const std::vector<uint8_t>& bytes) {
  struct Handles {
    jpeg_decompress_struct jpeg{};
    JpegErrors errors{};
    ~Handles() { jpeg_destroy_decompress(&jpeg); }
  } h;
  h.jpeg.err = jpeg_std_error(&h.errors.base);
  h.errors.base.error_exit = onJpegError;
  h.errors.base.emit_message = onJpegMessage;
  require(startJpeg(&h.jpeg, &h.errors, bytes), operation, ": ", path,
          ": corrupt JPEG: ", h.errors.message);
  const uint64_t pixels = uint64_t(h.jpeg.image_width) * h.jpeg.image_height;
  require(pixels <= kMaxPixels, operation, ": ", path, ": more than 2^28 pixels (",
          h.jpeg.image_width, " x ", h.jpeg.image_height, ")");
  require(pixels / kMaxJpegPixelsPerByte <= bytes.size(), operation, ": ", path,
          ": corrupt JPEG: ", bytes.size(), " bytes are too few for ", h.jpeg.image_width, " x ",
          h.jpeg.image_height, " pixels");
  const J_COLOR_SPACE space = h.jpeg.jpeg_color_space;
  require(space == JCS_GRAYSCALE || space == JCS_YCbCr || space == JCS_RGB, operation, ": ", path,
          ": expected a greyscale or RGB JPEG, found CMYK or another colour space");
  h.jpeg.out_color_space = space == JCS_GRAYSCALE ? JCS_GRAYSCALE : JCS_RGB;
  RawImage image;
  image.width = int(h.jpeg.image_width), image.height = int(h.jpeg.image_height);
  image.channels = space == JCS_GRAYSCALE ? 1 : 3;
  image.bits = 8;
  image.bytes.resize(image.rowBytes() * size_t(image.height));
  require(finishJpeg(&h.jpeg, &h.errors, &image), operation, ": ", path,
          ": corrupt JPEG: ", h.errors.message);
  return image;
}

bool startsWith(const std::vector<uint8_t>& bytes, std::initializer_list<uint8_t> magic) {
  return bytes.size() >= magic.size() && std::equal(magic.begin(), magic.end(), bytes.begin());
}

bool isPng(const std::vector<uint8_t>& bytes) {
  return startsWith(bytes, {0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n'});
}

void requireImage(const char* operation, const Image& image) {
  require(
      image.width > 0 && image.height > 0 && image.channels > 0 &&
          image.data.size() == size_t(image.width) * size_t(image.height) * size_t(image.channels),
      operation, ": inconsistent image: ", image.width, " x ", image.height, " x ", image.channels,
      ", ", image.data.size(), " values");
}

void requireSameSize(const char* operation, const Image& a, const Image& b) {
  requireImage(operation, a);
  requireImage(operation, b);
  require(a.width == b.width && a.height == b.height && a.channels == b.channels, operation,
          ": images differ in size: ", a.width, " x ", a.height, " x ", a.channels, " and ",
          b.width, " x ", b.height, " x ", b.channels);
}

/// Weights of the source samples [first, first + weights.size()) of one target sample.
struct Taps {
  int first = 0;
  std::vector<float> weights;
};

std::vector<Taps> resizeTaps(int from, int to) {
  std::vector<Taps> taps(static_cast<size_t>(to));
  const double scale = double(from) / to;  // source samples per target sample
  for (int i = 0; i < to; ++i) {
    Taps& t = taps[size_t(i)];
    if (scale > 1) {  // overlap of the target's interval with each source sample
      const double begin = i * scale, end = std::min((i + 1) * scale, double(from));
      t.first = std::min(int(begin), from - 1);
      for (int s = t.first; s < from && s < end; ++s) {
        const double overlap = std::min(end, s + 1.0) - std::max(begin, double(s));
        t.weights.push_back(float(overlap / (end - begin)));
      }
    } else {  // between the two nearest sample centres; the border value continues outside
      const double centre = std::clamp((i + 0.5) * scale - 0.5, 0.0, double(from - 1));
      t.first = int(centre);
      const float second = float(centre - t.first);
      t.weights.push_back(1 - second);
      if (second > 0) t.weights.push_back(second);
    }
  }
  return taps;
}

constexpr int kSsimWindow = 11;

/// Normalised Gaussian of sigma 1.5; the 11 x 11 window of Wang et al. 2004 is its outer product.
std::array<float, kSsimWindow> ssimWindow() {
  std::array<double, kSsimWindow> w{};
  double sum = 0;
  for (int i = 0; i < kSsimWindow; ++i) {
    const double d = i - kSsimWindow / 2;
    sum += w[size_t(i)] = std::exp(-d * d / (2 * 1.5 * 1.5));
  }
  std::array<float, kSsimWindow> result{};
  for (size_t i = 0; i < w.size(); ++i) result[i] = float(w[i] / sum);
  return result;
}

// The two loops below are nearly all of ssim()'s time; O3 lets them be vectorised, and the clone
// for the machine's registers is chosen when the program starts.
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define VDBC_VECTORISED \
  __attribute__((optimize("O3"), target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define VDBC_VECTORISED
#endif

constexpr float kSsimShift = 0.5f;  // variances do not see it, and their cancellation gets smaller

/// a, b, a^2, b^2 and a b of 11 rows (the first at `a`, `b`), filtered down the columns: [5, row].
VDBC_VECTORISED void ssimDown(const float* __restrict a, const float* __restrict b, size_t row,
                              const float* __restrict window, float* __restrict moments) {
  for (size_t i = 0; i < row; ++i) {
    float ma = 0, mb = 0, aa = 0, bb = 0, ab = 0;
    for (size_t k = 0; k < kSsimWindow; ++k) {
      const float va = a[k * row + i] - kSsimShift, vb = b[k * row + i] - kSsimShift;
      const float wa = window[k] * va, wb = window[k] * vb;
      ma += wa, mb += wb, aa += wa * va, bb += wb * vb, ab += wa * vb;
    }
    moments[i] = ma, moments[row + i] = mb;
    moments[2 * row + i] = aa, moments[3 * row + i] = bb, moments[4 * row + i] = ab;
  }
}

/// Filters the moments along the row: SSIM of its windows and channels.
VDBC_VECTORISED void ssimAcross(const float* __restrict moments, size_t row, size_t channels,
                                const float* __restrict window, float* __restrict value) {
  constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;
  const size_t count = row - (kSsimWindow - 1) * channels;
  for (size_t i = 0; i < count; ++i) {
    const float* from = moments + i;
    float m[5] = {};
    for (size_t k = 0; k < kSsimWindow; ++k) {
      for (size_t j = 0; j < 5; ++j) m[j] += window[k] * from[j * row + k * channels];
    }
    const float variances = (m[2] - m[0] * m[0]) + (m[3] - m[1] * m[1]);
    const float covariance = m[4] - m[0] * m[1];
    const float ma = m[0] + kSsimShift, mb = m[1] + kSsimShift;
    value[i] = (2 * ma * mb + kC1) * (2 * covariance + kC2) /
               ((ma * ma + mb * mb + kC1) * (variances + kC2));
  }
}

}  // namespace

float srgbFromLinear(float linear) {
  return linear <= 0.0031308f ? 12.92f * linear : 1.055f * std::pow(linear, 1 / 2.4f) - 0.055f;
}

float linearFromSrgb(float srgb) {
  return srgb <= 0.04045f ? srgb / 12.92f : std::pow((srgb + 0.055f) / 1.055f, 2.4f);
}

Image readImage(const std::string& path) {
  constexpr const char* kOperation = "readImage";
  const std::vector<uint8_t> bytes = readFile(kOperation, path, kMaxFileBytes);
  require(!bytes.empty(), kOperation, ": ", path, ": file is empty");
  RawImage raw;
  if (isPng(bytes)) {
    raw = decodePng(kOperation, path, bytes, false);
  } else {
    require(startsWith(bytes, {0xff, 0xd8, 0xff}), kOperation, ": ", path,
            ": expected a PNG or JPEG file, found another format");
    raw = decodeJpeg(kOperation, path, bytes);
  }
  require(raw.channels == 1 || raw.channels == 3, kOperation, ": ", path,
          ": expected 1 or 3 channels, found ", raw.channels);
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

std::vector<uint16_t> readPng16(const std::string& path, int* width, int* height) {
  constexpr const char* kOperation = "readPng16";
  const std::vector<uint8_t> bytes = readFile(kOperation, path, kMaxFileBytes);
  require(isPng(bytes), kOperation, ": ", path, ": expected a PNG file, found another format");
  const RawImage raw = decodePng(kOperation, path, bytes, true);
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
  RawImage raw{image.width, image.height, image.channels, 8, {}};
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
  RawImage raw{width, height, 1, 16, {}};
  raw.bytes.resize(data.size() * 2);
  std::memcpy(raw.bytes.data(), data.data(), raw.bytes.size());
  savePng(kOperation, raw, path);
}

Image resizeImage(const Image& image, int width, int height) {
  requireImage("resizeImage", image);
  require(width > 0 && height > 0, "resizeImage: expected a positive size, found ", width, " x ",
          height);
  const std::vector<Taps> across = resizeTaps(image.width, width);
  const std::vector<Taps> down = resizeTaps(image.height, height);
  const int channels = image.channels;
  Image narrow(width, image.height, channels), result(width, height, channels);
  tbb::parallel_for(0, image.height, [&](int y) {
    for (int x = 0; x < width; ++x) {
      const Taps& t = across[size_t(x)];
      for (int c = 0; c < channels; ++c) {
        float sum = 0;
        for (size_t k = 0; k < t.weights.size(); ++k) {
          sum += t.weights[k] * image.at(t.first + int(k), y, c);
        }
        narrow.at(x, y, c) = sum;
      }
    }
  });
  tbb::parallel_for(0, height, [&](int y) {
    const Taps& t = down[size_t(y)];
    float* to = &result.at(0, y, 0);
    for (size_t k = 0; k < t.weights.size(); ++k) {
      const float* from = &narrow.at(0, t.first + int(k), 0);
      for (size_t i = 0; i < size_t(width) * size_t(channels); ++i) to[i] += t.weights[k] * from[i];
    }
  });
  return result;
}

void pasteImage(const Image& from, int x, int y, Image* to) {
  requireImage("pasteImage", from);
  require(x >= 0 && y >= 0 && x + from.width <= to->width && y + from.height <= to->height &&
              from.channels == to->channels,
          "pasteImage: ", from.width, " x ", from.height, " x ", from.channels, " at ", x, ", ", y,
          " does not fit ", to->width, " x ", to->height, " x ", to->channels);
  const size_t row = size_t(from.width) * size_t(from.channels);
  for (int i = 0; i < from.height; ++i)
    std::copy_n(&from.data[size_t(i) * row], row, &to->at(x, y + i, 0));
}

double psnr(const Image& a, const Image& b) {
  requireSameSize("psnr", a, b);
  const size_t row = size_t(a.width) * size_t(a.channels);
  std::vector<double> sums(size_t(a.height));
  tbb::parallel_for(size_t(0), sums.size(), [&](size_t y) {
    double sum = 0;
    for (size_t i = y * row; i < (y + 1) * row; ++i) {
      const double d = double(a.data[i]) - double(b.data[i]);
      sum += d * d;
    }
    sums[y] = sum;
  });
  double sum = 0;
  for (double s : sums) sum += s;
  if (sum == 0) return std::numeric_limits<double>::infinity();
  return -10 * std::log10(sum / double(a.data.size()));
}

Image ssimMap(const Image& a, const Image& b) {
  requireSameSize("ssim", a, b);
  require(a.width >= kSsimWindow && a.height >= kSsimWindow,
          "ssim: expected images of at least 11 x 11 pixels, found ", a.width, " x ", a.height);
  const std::array<float, kSsimWindow> window = ssimWindow();
  const size_t row = size_t(a.width) * size_t(a.channels);
  Image map(a.width - 2 * kSsimBorder, a.height - 2 * kSsimBorder, a.channels);
  const size_t map_row = size_t(map.width) * size_t(map.channels);
  tbb::parallel_for(tbb::blocked_range<size_t>(0, size_t(map.height), 8), [&](const auto& range) {
    std::vector<float> moments(5 * row);
    for (size_t y = range.begin(); y < range.end(); ++y) {
      ssimDown(a.data.data() + y * row, b.data.data() + y * row, row, window.data(),
               moments.data());
      ssimAcross(moments.data(), row, size_t(a.channels), window.data(),
                 map.data.data() + y * map_row);
    }
  });
  return map;
}

double ssim(const Image& a, const Image& b) {
  const Image map = ssimMap(a, b);
  double sum = 0;
  for (float v : map.data) sum += double(v);
  return sum / double(map.data.size());
}

}  // namespace vdbc
