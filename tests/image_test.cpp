#include "splat/image.h"

#include <gtest/gtest.h>
#include <unistd.h>
// jpeglib.h needs stdio.h before it.
#include <jpeglib.h>

#include <cmath>
#include <cstdio>
#include <filesystem>
#include <fstream>
#include <limits>
#include <random>

#include "splat/image_files.h"
#include "vdb/error.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

class ImageFile : public testing::Test {
 protected:
  ImageFile() {
    const auto* test = testing::UnitTest::GetInstance()->current_test_info();
    folder_ = fs::temp_directory_path() / ("vdbc_image_" + std::to_string(getpid()) + test->name());
    fs::create_directories(folder_);
  }
  ~ImageFile() override { fs::remove_all(folder_); }
  std::string path(const std::string& name) const { return (folder_ / name).string(); }

  fs::path folder_;
};

std::string slurp(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

void spill(const std::string& path, const std::string& bytes) {
  fs::remove(path);  // ext4 flushes a file that is truncated and written again: 1 ms each
  std::ofstream(path, std::ios::binary) << bytes;
}

Image randomImage(int w, int h, int c, unsigned seed) {
  std::mt19937 random(seed);
  std::uniform_real_distribution<float> value(0.f, 1.f);
  Image image(w, h, c);
  for (float& v : image.data) v = value(random);
  return image;
}

/// A smooth picture, which JPEG keeps.
Image smoothImage(int w, int h, int c) {
  Image image(w, h, c);
  for (int y = 0; y < h; ++y)
    for (int x = 0; x < w; ++x)
      for (int k = 0; k < c; ++k)
        image.at(x, y, k) = 0.5f + 0.4f * std::sin(0.05f * float(x) + 0.03f * float(y) + float(k));
  return image;
}

/// Baseline or progressive JPEG of an image with 1 or 3 channels.
std::string jpegBytes(const Image& image, bool progressive) {
  jpeg_compress_struct jpeg;
  jpeg_error_mgr errors;
  jpeg.err = jpeg_std_error(&errors);
  jpeg_create_compress(&jpeg);
  unsigned char* memory = nullptr;
  unsigned long size = 0;
  jpeg_mem_dest(&jpeg, &memory, &size);
  jpeg.image_width = JDIMENSION(image.width);
  jpeg.image_height = JDIMENSION(image.height);
  jpeg.input_components = image.channels;
  jpeg.in_color_space = image.channels == 1 ? JCS_GRAYSCALE : JCS_RGB;
  jpeg_set_defaults(&jpeg);
  jpeg_set_quality(&jpeg, 95, TRUE);
  if (progressive) jpeg_simple_progression(&jpeg);
  jpeg_start_compress(&jpeg, TRUE);
  std::vector<unsigned char> row(size_t(image.width) * size_t(image.channels));
  for (int y = 0; y < image.height; ++y) {
    for (size_t i = 0; i < row.size(); ++i) {
      row[i] =
          static_cast<unsigned char>(std::lround(image.data[size_t(y) * row.size() + i] * 255.f));
    }
    JSAMPROW rows = row.data();
    jpeg_write_scanlines(&jpeg, &rows, 1);
  }
  jpeg_finish_compress(&jpeg);
  std::string bytes(reinterpret_cast<char*>(memory), size);
  jpeg_destroy_compress(&jpeg);
  std::free(memory);
  return bytes;
}

/// The definition: at each window position, weighted moments with the 2-D window, in double.
double bruteForceSsim(const Image& a, const Image& b) {
  double window[11][11], sum = 0;
  for (int j = 0; j < 11; ++j)
    for (int i = 0; i < 11; ++i)
      sum += window[j][i] = std::exp(-((i - 5) * (i - 5) + (j - 5) * (j - 5)) / (2 * 1.5 * 1.5));
  const double c1 = 1e-4, c2 = 9e-4;
  double total = 0;
  int64_t count = 0;
  for (int c = 0; c < a.channels; ++c)
    for (int y = 0; y + 11 <= a.height; ++y)
      for (int x = 0; x + 11 <= a.width; ++x) {
        double ma = 0, mb = 0, va = 0, vb = 0, cov = 0;
        for (int j = 0; j < 11; ++j)
          for (int i = 0; i < 11; ++i) {
            ma += window[j][i] / sum * a.at(x + i, y + j, c);
            mb += window[j][i] / sum * b.at(x + i, y + j, c);
          }
        for (int j = 0; j < 11; ++j)
          for (int i = 0; i < 11; ++i) {
            const double da = a.at(x + i, y + j, c) - ma, db = b.at(x + i, y + j, c) - mb;
            va += window[j][i] / sum * da * da;
            vb += window[j][i] / sum * db * db;
            cov += window[j][i] / sum * da * db;
          }
        total += (2 * ma * mb + c1) * (2 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
        ++count;
      }
  return total / double(count);
}

TEST(Srgb, MatchesTheStandardAndInverts) {
  EXPECT_NEAR(srgbFromLinear(0.18f), 0.46135612950044164, 1e-6);  // 1.055 * .18^(1/2.4) - .055
  EXPECT_NEAR(srgbFromLinear(1.f), 1.0, 1e-6);
  EXPECT_NEAR(linearFromSrgb(0.04045f), 0.04045 / 12.92, 1e-8);
  for (float v = -0.5f; v <= 1.5f; v += 0.01f) {
    EXPECT_NEAR(linearFromSrgb(srgbFromLinear(v)), v, 2e-6) << v;
  }
}

TEST_F(ImageFile, PngRoundTripIsExactAtEightBits) {
  for (int channels : {1, 3}) {
    Image image(37, 23, channels);
    std::mt19937 random(7);
    for (float& v : image.data) v = float(random() % 256) / 255.f;
    writePng(image, path("a.png"));
    const Image back = readImage(path("a.png"));
    EXPECT_EQ(back.width, 37);
    EXPECT_EQ(back.height, 23);
    EXPECT_EQ(back.channels, channels);
    EXPECT_EQ(back.data, image.data);
  }
  int files = 0;  // no temporary file stays behind
  for ([[maybe_unused]] const auto& entry : fs::directory_iterator(folder_)) ++files;
  EXPECT_EQ(files, 1);
}

TEST_F(ImageFile, WritePngClampsAndRoundsAndMakesNanBlack) {
  Image image(6, 1, 1);
  image.data = {-1.f,         2.f,         std::nanf(""), std::numeric_limits<float>::infinity(),
                0.499f / 255, 0.501f / 255};
  writePng(image, path("a.png"));
  const std::vector<float> expected = {0.f, 1.f, 0.f, 1.f, 0.f, 1.f / 255};
  EXPECT_EQ(readImage(path("a.png")).data, expected);
}

TEST_F(ImageFile, Png16RoundTripIsExact) {
  std::vector<uint16_t> data(65536);
  for (size_t i = 0; i < data.size(); ++i) data[i] = uint16_t(i * 40503);
  writePng16(data, 512, 128, path("d.png"));
  int w = 0, h = 0;
  EXPECT_EQ(readPng16(path("d.png"), &w, &h), data);
  EXPECT_EQ(w, 512);
  EXPECT_EQ(h, 128);
  const Image image = readImage(path("d.png"));  // the same file as values 0-1
  ASSERT_EQ(image.channels, 1);
  for (size_t i = 0; i < data.size(); i += 97) {
    EXPECT_FLOAT_EQ(image.data[i], float(data[i]) / 65535.f);
  }
}

TEST_F(ImageFile, Png16RefusesEightBitsAndColour) {
  int w = 0, h = 0;
  writePng(Image(4, 4, 1), path("grey.png"));
  writePng(Image(4, 4, 3), path("colour.png"));
  EXPECT_THROW(readPng16(path("grey.png"), &w, &h), Error);
  EXPECT_THROW(readPng16(path("colour.png"), &w, &h), Error);
}

TEST_F(ImageFile, JpegIsReadWithinItsLoss) {
  for (int channels : {1, 3}) {
    for (bool progressive : {false, true}) {
      const Image image = smoothImage(96, 64, channels);
      spill(path("a.jpg"), jpegBytes(image, progressive));
      const Image back = readImage(path("a.jpg"));
      ASSERT_EQ(back.channels, channels);
      EXPECT_GT(psnr(back, image), 35);
    }
  }
}

TEST_F(ImageFile, EveryTruncationThrows) {
  const Image image = smoothImage(24, 16, 3);
  writePng(image, path("whole.png"));
  writePng16(std::vector<uint16_t>(24 * 16, 1234), 24, 16, path("whole16.png"));
  int w = 0, h = 0;
  for (const std::string& bytes : {slurp(path("whole.png")), slurp(path("whole16.png")),
                                   jpegBytes(image, false), jpegBytes(image, true)}) {
    spill(path("cut"), bytes);
    EXPECT_NO_THROW(readImage(path("cut")));
    for (size_t n = 0; n < bytes.size(); n += n < 100 || n + 40 > bytes.size() ? 1 : 5) {
      spill(path("cut"), bytes.substr(0, n));
      EXPECT_THROW(readImage(path("cut")), Error) << n << " of " << bytes.size();
      EXPECT_THROW(readPng16(path("cut"), &w, &h), Error) << n << " of " << bytes.size();
    }
  }
}

TEST_F(ImageFile, FlippedBytesNeverCrash) {
  const Image image = smoothImage(24, 16, 3);
  writePng(image, path("whole.png"));
  std::mt19937 random(3);
  for (const std::string& bytes :
       {slurp(path("whole.png")), jpegBytes(image, false), jpegBytes(image, true)}) {
    for (int i = 0; i < 150; ++i) {
      std::string damaged = bytes;
      damaged[random() % damaged.size()] = char(random());
      spill(path("damaged"), damaged);
      try {
        const Image read = readImage(path("damaged"));
        EXPECT_EQ(read.data.size(),
                  size_t(read.width) * size_t(read.height) * size_t(read.channels));
      } catch (const Error&) {
      }
    }
  }
}

TEST_F(ImageFile, HostileSizesAreRefusedBeforeMemoryIsTaken) {
  // IHDR with its right CRC, so that only the size can be what is wrong.
  const auto crc = [](const std::string& bytes) {
    uint32_t c = 0xffffffffu;
    for (unsigned char b : bytes) {
      c ^= b;
      for (int k = 0; k < 8; ++k) c = c & 1 ? 0xedb88320u ^ (c >> 1) : c >> 1;
    }
    return c ^ 0xffffffffu;
  };
  const auto bigEndian = [](uint32_t v) {
    return std::string{char(v >> 24), char(v >> 16), char(v >> 8), char(v)};
  };
  writePng(Image(4, 4, 3), path("small.png"));
  const std::string small = slurp(path("small.png"));
  for (const auto& [w, h] : {std::pair<uint32_t, uint32_t>{1u << 31, 4},
                             {0x7fffffffu, 0x7fffffffu},
                             {16384, 16384},
                             {0, 4},
                             {1000000, 256}}) {
    const std::string ihdr = "IHDR" + bigEndian(w) + bigEndian(h) + small.substr(24, 5);
    spill(path("huge.png"), small.substr(0, 12) + ihdr + bigEndian(crc(ihdr)) + small.substr(33));
    EXPECT_THROW(readImage(path("huge.png")), Error) << w << " x " << h;
  }
  std::string jpeg = jpegBytes(smoothImage(16, 16, 3), false);
  const size_t frame = jpeg.find("\xff\xc0");
  ASSERT_NE(frame, std::string::npos);
  for (size_t i = 5; i < 9; ++i) jpeg[frame + i] = char(0xff);  // 65535 x 65535
  spill(path("huge.jpg"), jpeg);
  EXPECT_THROW(readImage(path("huge.jpg")), Error);
}

TEST_F(ImageFile, MissingAndForeignFilesThrowOneLineThatNamesThePath) {
  spill(path("text.png"), "hello");
  spill(path("empty.png"), "");
  for (const char* name : {"none.png", "text.png", "empty.png", ""}) {
    try {
      readImage(path(name));
      FAIL() << name;
    } catch (const Error& error) {
      const std::string message = error.what();
      EXPECT_NE(message.find(path(name)), std::string::npos) << message;
      EXPECT_EQ(message.find('\n'), std::string::npos) << message;
    }
  }
}

TEST_F(ImageFile, FailedWritesThrowAndLeaveNothing) {
  EXPECT_THROW(writePng(Image(4, 4, 3), path("no/such/folder/a.png")), Error);
  EXPECT_THROW(writePng(Image(4, 4, 2), path("two_channels.png")), Error);
  EXPECT_THROW(writePng(Image(), path("empty.png")), Error);
  EXPECT_THROW(writePng16({1, 2, 3}, 2, 2, path("short.png")), Error);
  EXPECT_TRUE(fs::is_empty(folder_));
}

TEST(Resize, SameSizeIsIdentity) {
  const Image image = randomImage(17, 9, 3, 1);
  EXPECT_EQ(resizeImage(image, 17, 9).data, image.data);
}

TEST(Resize, ShrinkingKeepsTheMeanAndEqualsBlockMeans) {
  const Image image = randomImage(24, 18, 3, 2);
  const Image half = resizeImage(image, 8, 6);  // blocks of 3 x 3
  for (int y = 0; y < 6; ++y)
    for (int x = 0; x < 8; ++x)
      for (int c = 0; c < 3; ++c) {
        double mean = 0;
        for (int j = 0; j < 3; ++j)
          for (int i = 0; i < 3; ++i) mean += image.at(3 * x + i, 3 * y + j, c) / 9.0;
        EXPECT_NEAR(half.at(x, y, c), mean, 1e-6);
      }
  const auto meanOf = [](const Image& im) {
    double sum = 0;
    for (float v : im.data) sum += v;
    return sum / double(im.data.size());
  };
  EXPECT_NEAR(meanOf(resizeImage(image, 7, 5)), meanOf(image), 1e-6);  // fractions of pixels too
}

TEST(Resize, GrowingIsExactOnLinearRampsInside) {
  Image ramp(8, 8, 1);
  for (int y = 0; y < 8; ++y)
    for (int x = 0; x < 8; ++x) ramp.at(x, y, 0) = 0.1f * float(x) + 0.02f * float(y);
  const Image big = resizeImage(ramp, 20, 12);
  for (int y = 1; y < 11; ++y)
    for (int x = 2; x < 18; ++x) {
      const double sx = (x + 0.5) * 8 / 20 - 0.5, sy = (y + 0.5) * 8 / 12 - 0.5;
      EXPECT_NEAR(big.at(x, y, 0), 0.1 * sx + 0.02 * sy, 1e-6);
    }
}

TEST(Tiles, StandInRowsInTheirCells) {
  const Image sheet = tileImages({Image(2, 3, 3, .5f), Image(), Image(4, 1, 3, .75f)}, 2);
  ASSERT_EQ(sheet.width, 8);
  ASSERT_EQ(sheet.height, 6);
  for (int y = 0; y < 6; ++y)
    for (int x = 0; x < 8; ++x)
      for (int c = 0; c < 3; ++c) {
        const bool first = x < 2 && y < 3, third = x < 4 && y == 3;
        EXPECT_EQ(sheet.at(x, y, c), first ? .5f : third ? .75f : .15f) << x << ", " << y;
      }
  EXPECT_EQ(tileImages({Image(5, 4, 3)}, 8).width, 5);
  EXPECT_THROW(tileImages({}, 8), Error);
  EXPECT_THROW(tileImages({Image()}, 8), Error);
  EXPECT_THROW(tileImages({Image(5, 4, 1)}, 8), Error);
}

TEST(Psnr, ClosedForms) {
  Image a(13, 7, 3, 0.25f), b(13, 7, 3, 0.75f);
  EXPECT_NEAR(psnr(a, b), 20 * std::log10(2.0), 1e-9);  // mse 1/4
  EXPECT_EQ(psnr(a, a), std::numeric_limits<double>::infinity());
  Image c = a;
  c.data[5] += 0.5f;  // one value of 273
  EXPECT_NEAR(psnr(a, c), 10 * std::log10(273 * 4.0), 1e-9);
}

TEST(Metrics, RefuseImagesOfDifferentSizes) {
  EXPECT_THROW(psnr(Image(12, 12, 3), Image(12, 13, 3)), Error);
  EXPECT_THROW(ssim(Image(12, 12, 3), Image(12, 12, 1)), Error);
  EXPECT_THROW(ssim(Image(10, 12, 3), Image(10, 12, 3)), Error);  // no window fits
}

TEST(Ssim, EqualsBruteForce) {
  for (int channels : {1, 3}) {
    const Image a = randomImage(29, 17, channels, 11), b = randomImage(29, 17, channels, 12);
    const Image smooth = smoothImage(29, 17, channels);
    Image noisy = smooth;
    for (size_t i = 0; i < noisy.data.size(); ++i) noisy.data[i] += 0.02f * (a.data[i] - 0.5f);
    EXPECT_NEAR(ssim(a, b), bruteForceSsim(a, b), 1e-5);
    EXPECT_NEAR(ssim(smooth, noisy), bruteForceSsim(smooth, noisy), 1e-5);
    EXPECT_NEAR(ssim(smooth, b), bruteForceSsim(smooth, b), 1e-5);
  }
}

TEST(Ssim, ClosedFormsAndSymmetry) {
  const Image a = randomImage(40, 30, 3, 5), b = randomImage(40, 30, 3, 6);
  EXPECT_NEAR(ssim(a, a), 1.0, 1e-6);
  EXPECT_NEAR(ssim(a, b), ssim(b, a), 1e-7);
  // Constant images: only the luminance term is left.
  const double expected = (2 * 0.2 * 0.6 + 1e-4) / (0.2 * 0.2 + 0.6 * 0.6 + 1e-4);
  EXPECT_NEAR(ssim(Image(16, 16, 1, 0.2f), Image(16, 16, 1, 0.6f)), expected, 1e-4);
}

}  // namespace
}  // namespace vdbc
