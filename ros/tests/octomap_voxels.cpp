// The voxels of an octree as OctoMap's own library reads it: of a .bt file, or of the data of an octomap_msgs/Octomap.
//
//   g++ -O2 -std=c++17 octomap_voxels.cpp -loctomap -loctomath -o octomap_voxels
//   octomap_voxels FILE.bt               a file
//   octomap_voxels message RESOLUTION    the data of a binary message, from standard input
//
// On standard output: the resolution as a double, then x, y, z, state of each voxel as int32; 1 is free, 2 is occupied.
#include <octomap/octomap.h>

#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <iostream>

int main(int count, char** args) {
  const bool is_message = count == 3 && std::strcmp(args[1], "message") == 0;
  if (!is_message && count != 2) return 2;
  octomap::OcTree tree(is_message ? std::atof(args[2]) : 1.0);
  if (is_message ? !tree.readBinaryData(std::cin) : !tree.readBinary(args[1])) {
    std::fprintf(stderr, "OctoMap cannot read it\n");
    return 1;
  }
  const double resolution = tree.getResolution();
  std::fwrite(&resolution, sizeof resolution, 1, stdout);
  for (auto leaf = tree.begin_leafs(); leaf != tree.end_leafs(); ++leaf) {
    // A leaf above the lowest level stands for all voxels in it.
    const int side = 1 << (tree.getTreeDepth() - leaf.getDepth());
    const octomap::OcTreeKey low = leaf.getIndexKey();
    const int32_t state = tree.isNodeOccupied(*leaf) ? 2 : 1;
    for (int z = 0; z < side; z++)
      for (int y = 0; y < side; y++)
        for (int x = 0; x < side; x++) {
          const int32_t voxel[4] = {low[0] + x - 32768, low[1] + y - 32768, low[2] + z - 32768, state};
          std::fwrite(voxel, sizeof voxel, 1, stdout);
        }
  }
  return std::fflush(stdout) == 0 ? 0 : 1;
}
