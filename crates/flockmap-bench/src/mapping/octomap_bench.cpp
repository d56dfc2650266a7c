// OctoMap's half of `flockmap-bench mapping`: inserts the scans of a file, tells how long each took, and dumps the map.
//
// Arguments: scan file, dump file, resolution in metres, range in metres.
// Scan file, little-endian: u32 scans; for each: f32 sensor x y z, u32 points, f32 x y z of each point, all in the map's frame.
// Dump file, little-endian: for each voxel of the finest size i32 x y z, u8 state (1 occupied, 0 free).
// Standard output: a line "scan MILLISECONDS" for each scan, then "memory BYTES".
#include <octomap/octomap.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

template <typename T>
static T read(std::FILE* file) {
  T value;
  if (std::fread(&value, sizeof value, 1, file) != 1) {
    std::fprintf(stderr, "the scan file ends too early\n");
    std::exit(1);
  }
  return value;
}

int main(int count, char** arguments) {
  if (count != 5) return 2;
  std::FILE* in = std::fopen(arguments[1], "rb");
  std::FILE* out = std::fopen(arguments[2], "wb");
  if (in == nullptr || out == nullptr) return 2;
  octomap::OcTree tree(std::atof(arguments[3]));
  const double range = std::atof(arguments[4]);

  const uint32_t scans = read<uint32_t>(in);
  for (uint32_t scan = 0; scan < scans; ++scan) {
    float origin[3];
    for (float& v : origin) v = read<float>(in);
    const uint32_t points = read<uint32_t>(in);
    octomap::Pointcloud cloud;
    cloud.reserve(points);
    for (uint32_t point = 0; point < points; ++point) {
      float p[3];
      for (float& v : p) v = read<float>(in);
      cloud.push_back(p[0], p[1], p[2]);
    }
    const auto start = std::chrono::steady_clock::now();
    tree.insertPointCloud(cloud, octomap::point3d(origin[0], origin[1], origin[2]), range);
    const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
    std::printf("scan %.6f\n", took.count());
    std::fflush(stdout);
  }
  std::printf("memory %zu\n", tree.memoryUsage());

  for (auto leaf = tree.begin_leafs(); leaf != tree.end_leafs(); ++leaf) {
    const uint8_t state = tree.isNodeOccupied(*leaf) ? 1 : 0;
    const int32_t side = 1 << (tree.getTreeDepth() - leaf.getDepth());
    const octomap::OcTreeKey key = leaf.getIndexKey();
    for (int32_t x = 0; x < side; ++x)
      for (int32_t y = 0; y < side; ++y)
        for (int32_t z = 0; z < side; ++z) {
          const int32_t voxel[3] = {key[0] + x - 32768, key[1] + y - 32768, key[2] + z - 32768};
          std::fwrite(voxel, sizeof voxel, 1, out);
          std::fwrite(&state, 1, 1, out);
        }
  }
  return std::fclose(out) == 0 ? 0 : 1;
}
