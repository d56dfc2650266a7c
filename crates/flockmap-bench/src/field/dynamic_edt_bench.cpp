// The half of OctoMap's dynamicEDT3D of `flockmap-bench field`.
//
// Argument: a file with a box, little-endian: u32 x y z, then two times u8 for each voxel (1 is an obstacle; x
// fastest): the box before and after a scan. Standard input: "anew" times a map of the box after the scan, from
// initializeMap to the end of update; "update" times what the scan changed, from the first occupyCell or clearCell to
// the end of update; "write PATH" writes the squared distances of a map made anew as f32. Standard output: for each
// line, milliseconds.
#include <dynamicEDT3D/dynamicEDT3D.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <fstream>
#include <iostream>
#include <iterator>
#include <memory>
#include <string>
#include <vector>

using Clock = std::chrono::steady_clock;

static uint32_t size[3];
static std::vector<char> cells[2];

static bool occupied(int when, uint32_t x, uint32_t y, uint32_t z) {
  return cells[when][(static_cast<size_t>(z) * size[1] + y) * size[0] + x] != 0;
}

// As initializeMap takes it and, in its destructor, lets go of it.
static bool*** grid(int when) {
  bool*** out = new bool**[size[0]];
  for (uint32_t x = 0; x < size[0]; ++x) {
    out[x] = new bool*[size[1]];
    for (uint32_t y = 0; y < size[1]; ++y) {
      out[x][y] = new bool[size[2]];
      for (uint32_t z = 0; z < size[2]; ++z) out[x][y][z] = occupied(when, x, y, z);
    }
  }
  return out;
}

int main(int count, char** arguments) {
  if (count != 2) return 2;
  std::ifstream in(arguments[1], std::ios::binary);
  in.read(reinterpret_cast<char*>(size), sizeof size);
  for (auto& half : cells) {
    half.resize(static_cast<size_t>(size[0]) * size[1] * size[2]);
    in.read(half.data(), static_cast<std::streamsize>(half.size()));
  }
  if (!in) return 2;
  // No distance of the box is cut.
  const int longest = static_cast<int>(size[0] * size[0] + size[1] * size[1] + size[2] * size[2]);

  std::string word;
  while (std::cin >> word) {
    const bool update = word == "update";
    auto map = std::make_unique<DynamicEDT3D>(longest);
    bool*** first = grid(update ? 0 : 1);
    std::vector<INTPOINT3D> gone, come;
    for (uint32_t x = 0; x < size[0]; ++x)
      for (uint32_t y = 0; y < size[1]; ++y)
        for (uint32_t z = 0; z < size[2]; ++z)
          if (occupied(0, x, y, z) != occupied(1, x, y, z))
            (occupied(0, x, y, z) ? gone : come).push_back(INTPOINT3D(x, y, z));
    if (update) {
      map->initializeMap(size[0], size[1], size[2], first);
      map->update(false);
    }
    const auto start = Clock::now();
    if (update) {
      for (const auto& at : gone) map->clearCell(at.x, at.y, at.z);
      for (const auto& at : come) map->occupyCell(at.x, at.y, at.z);
    } else {
      map->initializeMap(size[0], size[1], size[2], first);
    }
    map->update(false);
    const auto milliseconds = std::chrono::duration<double, std::milli>(Clock::now() - start).count();
    if (word == "write") {
      std::cin >> word;
      std::ofstream out(word, std::ios::binary);
      for (uint32_t z = 0; z < size[2]; ++z)
        for (uint32_t y = 0; y < size[1]; ++y)
          for (uint32_t x = 0; x < size[0]; ++x) {
            const float squared = static_cast<float>(map->getSQCellDistance(x, y, z));
            out.write(reinterpret_cast<const char*>(&squared), sizeof squared);
          }
    }
    std::cout << milliseconds << std::endl;
  }
}
