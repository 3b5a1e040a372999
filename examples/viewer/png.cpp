// The least that is a PNG: a zlib stream of stored blocks, so nothing is compressed.

#include "png.h"

#include <algorithm>
#include <fstream>
#include <stdexcept>

namespace {

using Bytes = std::vector<uint8_t>;

void put(Bytes &to, uint32_t value) {
    for (int shift = 24; shift >= 0; shift -= 8) to.push_back(uint8_t(value >> shift));
}

uint32_t crc(const uint8_t *data, size_t count) {
    uint32_t c = ~0u;
    for (size_t i = 0; i < count; i++) {
        c ^= data[i];
        for (int bit = 0; bit < 8; bit++) c = c >> 1 ^ (c & 1 ? 0xedb88320u : 0);
    }
    return ~c;
}

void put_chunk(Bytes &png, const char *type, const Bytes &data) {
    put(png, uint32_t(data.size()));
    const size_t begin = png.size();
    png.insert(png.end(), type, type + 4);
    png.insert(png.end(), data.begin(), data.end());
    put(png, crc(&png[begin], png.size() - begin));
}

Bytes zlib(const Bytes &raw) {
    Bytes z = {0x78, 0x01};
    uint32_t a = 1, b = 0;
    for (size_t begin = 0; begin < raw.size(); begin += 65535) {
        const size_t count = std::min<size_t>(raw.size() - begin, 65535);
        const bool last = begin + count == raw.size();
        z.push_back(last);
        for (size_t field : {count, ~count}) {
            z.push_back(uint8_t(field));
            z.push_back(uint8_t(field >> 8));
        }
        for (size_t i = begin; i < begin + count; i++) {
            z.push_back(raw[i]);
            a = (a + raw[i]) % 65521;
            b = (b + a) % 65521;
        }
    }
    put(z, b << 16 | a);
    return z;
}

} // namespace

void write_png(const std::string &path, int width, int height, const std::vector<uint8_t> &rgb) {
    Bytes rows;
    for (int y = height - 1; y >= 0; y--) {
        rows.push_back(0); // no filter
        const auto row = rgb.begin() + ptrdiff_t(y) * width * 3;
        rows.insert(rows.end(), row, row + width * 3);
    }
    Bytes png = {0x89, 'P', 'N', 'G', '\r', '\n', 0x1a, '\n'}, header;
    put(header, uint32_t(width));
    put(header, uint32_t(height));
    header.insert(header.end(), {8, 2, 0, 0, 0}); // eight bits, RGB
    put_chunk(png, "IHDR", header);
    put_chunk(png, "IDAT", zlib(rows));
    put_chunk(png, "IEND", {});
    std::ofstream out(path, std::ios::binary);
    out.write(reinterpret_cast<const char *>(png.data()), std::streamsize(png.size()));
    if (!out.flush()) throw std::runtime_error(path + " cannot be written");
}
