#include "splat/image_files.h"

#include <gtest/gtest.h>
// jpeglib.h needs stdio.h before it.
#include <jpeglib.h>
#include <png.h>

#include <cmath>
#include <cstdlib>
#include <filesystem>
#include <limits>
#include <random>

#include "tests/expect_error.h"
#include "tests/files.h"
#include "tests/view_files.h"

namespace vdbc {
namespace {

namespace fs = std::filesystem;

class ImageFile : public testing::Test {
 protected:
  std::string path(const std::string& name) const { return folder_ / name; }

  TemporaryFolder folder_;
};

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
  for ([[maybe_unused]] const auto& entry : fs::directory_iterator(folder_.path)) ++files;
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
      writeBytes(path("a.jpg"), jpegBytes(image, progressive));
      const Image back = readImage(path("a.jpg"));
      ASSERT_EQ(back.channels, channels);
      EXPECT_GT(psnr(back, image), 35);
    }
  }
}

TEST_F(ImageFile, RgbaIsTheSameEightBitsWithCoverage) {
  // Paint grey, colour and 16 bits; whatever has no alpha is opaque.
  const auto rgbaOf = [&](const std::string& bytes) {
    int width = 0, height = 0;
    std::vector<uint8_t> rgba =
        decodeRgba("test", "a picture", bytes.data(), bytes.size(), &width, &height);
    EXPECT_EQ(rgba.size(), size_t(4 * width * height));
    return rgba;
  };
  for (int channels : {1, 3}) {
    const Image image = smoothImage(24, 16, channels);
    writePng(image, path("a.png"));
    const Image stored = readImage(path("a.png"));
    const std::vector<uint8_t> png = rgbaOf(bytesOf(path("a.png")));
    for (size_t i = 0; i < 24 * 16; ++i) {
      for (size_t c = 0; c < 3; ++c) {
        const float value = stored.data[i * size_t(channels) + (channels == 1 ? 0 : c)];
        EXPECT_EQ(png[4 * i + c], std::lround(value * 255));
      }
      EXPECT_EQ(png[4 * i + 3], 255);
    }
    const std::string jpeg = jpegBytes(image, false);
    const Image back = decodeImage("test", "a picture", jpeg.data(), jpeg.size());
    const std::vector<uint8_t> rgba = rgbaOf(jpeg);
    for (size_t i = 0; i < 24 * 16; ++i)
      EXPECT_EQ(rgba[4 * i], std::lround(back.data[i * size_t(channels)] * 255));
  }
  writePng16({0, 128, 32896, 65535}, 2, 2, path("d.png"));
  EXPECT_EQ(
      rgbaOf(bytesOf(path("d.png"))),
      (std::vector<uint8_t>{0, 0, 0, 255, 0, 0, 0, 255, 128, 128, 128, 255, 255, 255, 255, 255}));
}

TEST_F(ImageFile, AlphaIsKeptOrDropped) {
  // Two pixels written by libpng's own simple interface: half covered red, uncovered blue.
  png_image header{};
  header.version = PNG_IMAGE_VERSION;
  header.width = 2, header.height = 1, header.format = PNG_FORMAT_RGBA;
  const std::vector<uint8_t> rgba = {255, 0, 0, 127, 0, 0, 255, 0};
  ASSERT_TRUE(png_image_write_to_file(&header, path("a.png").c_str(), 0, rgba.data(), 0, nullptr));
  const std::string bytes = bytesOf(path("a.png"));
  int width = 0, height = 0;
  EXPECT_EQ(decodeRgba("test", "a", bytes.data(), bytes.size(), &width, &height), rgba);
  EXPECT_EQ(readImage(path("a.png")).data, (std::vector<float>{1, 0, 0, 0, 0, 1}));
}

TEST_F(ImageFile, PicturesInMemoryFailInTheirCallersName) {
  const std::string text = "GIF89a";
  int width = 0, height = 0;
  expectError([&] { decodeImage("readTexture", "jar: a.gif", text.data(), text.size()); },
              {"readTexture: jar: a.gif: ", "PNG or JPEG"});
  expectError([&] { decodeRgba("readTexture", "jar: a", text.data(), 0, &width, &height); },
              {"readTexture: jar: a: ", "empty"});
}

TEST_F(ImageFile, EveryTruncationThrows) {
  const Image image = smoothImage(24, 16, 3);
  writePng(image, path("whole.png"));
  writePng16(std::vector<uint16_t>(24 * 16, 1234), 24, 16, path("whole16.png"));
  int w = 0, h = 0;
  for (const std::string& bytes : {bytesOf(path("whole.png")), bytesOf(path("whole16.png")),
                                   jpegBytes(image, false), jpegBytes(image, true)}) {
    writeBytes(path("cut"), bytes);
    EXPECT_NO_THROW(readImage(path("cut")));
    for (size_t n = 0; n < bytes.size(); n += n < 100 || n + 40 > bytes.size() ? 1 : 5) {
      writeBytes(path("cut"), bytes.substr(0, n));
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
       {bytesOf(path("whole.png")), jpegBytes(image, false), jpegBytes(image, true)}) {
    for (int i = 0; i < 150; ++i) {
      std::string damaged = bytes;
      damaged[random() % damaged.size()] = char(random());
      writeBytes(path("damaged"), damaged);
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
  const std::string small = bytesOf(path("small.png"));
  for (const auto& [w, h] : {std::pair<uint32_t, uint32_t>{1u << 31, 4},
                             {0x7fffffffu, 0x7fffffffu},
                             {16384, 16384},
                             {0, 4},
                             {1000000, 256}}) {
    const std::string ihdr = "IHDR" + bigEndian(w) + bigEndian(h) + small.substr(24, 5);
    writeBytes(path("huge.png"),
               small.substr(0, 12) + ihdr + bigEndian(crc(ihdr)) + small.substr(33));
    EXPECT_THROW(readImage(path("huge.png")), Error) << w << " x " << h;
  }
  std::string jpeg = jpegBytes(smoothImage(16, 16, 3), false);
  const size_t frame = jpeg.find("\xff\xc0");
  ASSERT_NE(frame, std::string::npos);
  for (size_t i = 5; i < 9; ++i) jpeg[frame + i] = char(0xff);  // 65535 x 65535
  writeBytes(path("huge.jpg"), jpeg);
  EXPECT_THROW(readImage(path("huge.jpg")), Error);
}

TEST_F(ImageFile, MissingAndForeignFilesThrowOneLineThatNamesThePath) {
  writeBytes(path("text.png"), "hello");
  writeBytes(path("empty.png"), "");
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
  EXPECT_TRUE(fs::is_empty(folder_.path));
}

}  // namespace
}  // namespace vdbc
