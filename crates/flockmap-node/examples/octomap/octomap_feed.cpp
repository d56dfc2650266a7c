// A robot that maps with OctoMap and lets Flockmap tell its team-mates. Messages as in docs/sensor-input.md.
//
//   g++ -O2 -std=c++17 octomap_feed.cpp -loctomap -loctomath -o octomap_feed
//   octomap_feed feed SCANS PORT keys|box RESOLUTION RANGE TREE.bt   inserts scans, sends what changed
//   octomap_feed check TREE.bt MAP.bt ...                        compares maps with the tree, voxel by voxel
//
// SCANS: messages of kind 1, as the example `record_messages` writes them. PORT: of the node, on this machine.
// keys: after each scan what OctoMap's change detection names, as single voxels (kind 4). box: after every fifth
// scan the box of RANGE metres round the sensor (kind 5).
#include <arpa/inet.h>
#include <octomap/octomap.h>
#include <sys/socket.h>
#include <unistd.h>

#include <array>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <fstream>
#include <map>
#include <string>
#include <vector>

using octomap::OcTree;
using octomap::OcTreeKey;
using Voxel = std::array<int32_t, 3>;

// Numbers go out as they lie in memory: little-endian, as on every machine that flies.
static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__, "swap the bytes in `put`");

enum State : uint8_t { UNKNOWN = 0, FREE = 1, OCCUPIED = 2 };

struct Message {
  std::string bytes = std::string(4, '\0');

  template <class T>
  void put(T value) {
    bytes.append(reinterpret_cast<const char*>(&value), sizeof value);
  }

  // What both kinds begin with. Stamp 0: now.
  Message(uint8_t kind, double resolution, const octomap::point3d& sensor, uint32_t flags) {
    bytes += "FLKS";
    put<uint8_t>(1);
    put<uint8_t>(kind);
    put<uint16_t>(0);
    put<int64_t>(0);
    put<double>(resolution);
    for (unsigned axis = 0; axis < 3; axis++) put<double>(sensor(axis));
    put<uint32_t>(flags);
  }

  void send(int node) {
    const uint32_t length = bytes.size() - 4;
    std::memcpy(&bytes[0], &length, 4);
    for (size_t sent = 0; sent < bytes.size();) {
      const ssize_t more = ::send(node, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
      if (more <= 0) {
        std::perror("the node does not listen any more");
        std::exit(1);
      }
      sent += more;
    }
  }
};

// The sensor's place is given: the codec needs fewer bytes then.
constexpr uint32_t SENSOR_GIVEN = 1;

// OctoMap's keys begin at 0, Flockmap's voxels at the origin of the map.
constexpr int32_t KEY_OF_ORIGIN = 32768;

State state_of(const OcTree& tree, const octomap::OcTreeNode* node) {
  return !node ? UNKNOWN : tree.isNodeOccupied(node) ? OCCUPIED : FREE;
}

// What has changed since the last call. A key that flipped back is not among them.
void send_changed_keys(OcTree& tree, const octomap::point3d& sensor, int node) {
  Message message(4, tree.getResolution(), sensor, SENSOR_GIVEN);
  message.put<uint32_t>(tree.numChangesDetected());
  for (auto changed = tree.changedKeysBegin(); changed != tree.changedKeysEnd(); ++changed) {
    const OcTreeKey& key = changed->first;
    for (unsigned axis = 0; axis < 3; axis++) message.put<int32_t>(int32_t(key[axis]) - KEY_OF_ORIGIN);
    // The leaf may lie above the lowest level: `search` finds that one too.
    message.put<uint8_t>(state_of(tree, tree.search(key)));
  }
  message.send(node);
  tree.resetChangeDetection();
}

// For each voxel of each leaf. A leaf above the lowest level stands for a cube of voxels.
template <class Leaf, class Visit>
void each_voxel(const Leaf& leaf, Visit visit) {
  const int32_t side = 1 << (16 - leaf.getDepth());
  const OcTreeKey low = leaf.getIndexKey();
  for (int32_t z = 0; z < side; z++)
    for (int32_t y = 0; y < side; y++)
      for (int32_t x = 0; x < side; x++)
        visit({low[0] + x - KEY_OF_ORIGIN, low[1] + y - KEY_OF_ORIGIN, low[2] + z - KEY_OF_ORIGIN});
}

// All that is known within `range` of the sensor along each axis.
void send_box(const OcTree& tree, const octomap::point3d& sensor, double range, int node) {
  OcTreeKey low, high;
  const octomap::point3d reach(range, range, range);
  if (!tree.coordToKeyChecked(sensor - reach, low) || !tree.coordToKeyChecked(sensor + reach, high)) return;
  int32_t min[3];
  uint32_t size[3];
  for (unsigned axis = 0; axis < 3; axis++) {
    min[axis] = int32_t(low[axis]) - KEY_OF_ORIGIN;
    size[axis] = uint32_t(high[axis]) - low[axis] + 1;
  }
  std::string states(size_t(size[0]) * size[1] * size[2], char(UNKNOWN));
  for (auto leaf = tree.begin_leafs_bbx(low, high); leaf != tree.end_leafs_bbx(); ++leaf) {
    const State state = state_of(tree, &*leaf);
    each_voxel(leaf, [&](const Voxel& voxel) {
      size_t place = 0;
      for (int axis = 2; axis >= 0; axis--) {
        const int64_t at = int64_t(voxel[axis]) - min[axis];
        if (at < 0 || at >= size[axis]) return;
        place = place * size[axis] + at;
      }
      states[place] = char(state);
    });
  }
  Message message(5, tree.getResolution(), sensor, SENSOR_GIVEN);
  for (int32_t at : min) message.put(at);
  for (uint32_t side : size) message.put(side);
  message.bytes += states;
  message.send(node);
}

// A scan in the frame of the map, and where the sensor was. False at the end.
bool read_scan(std::ifstream& scans, octomap::Pointcloud& cloud, octomap::point3d& sensor) {
  uint32_t length = 0;
  if (!scans.read(reinterpret_cast<char*>(&length), 4)) return false;
  std::vector<char> body(length);
  if (length < 80 || !scans.read(body.data(), length) || std::memcmp(body.data(), "FLKS\1\1", 6) != 0) {
    std::fprintf(stderr, "this is no scan\n");
    std::exit(1);
  }
  double pose[7];
  uint32_t points;
  std::memcpy(pose, &body[16], sizeof pose);
  std::memcpy(&points, &body[72], 4);
  cloud.clear();
  for (uint32_t i = 0; i < points; i++) {
    float p[3];
    std::memcpy(p, &body[80 + 12 * size_t(i)], sizeof p);
    cloud.push_back(p[0], p[1], p[2]);
  }
  const octomath::Quaternion rotation(pose[6], pose[3], pose[4], pose[5]);
  sensor = octomap::point3d(pose[0], pose[1], pose[2]);
  cloud.transform(octomap::pose6d(sensor, rotation));
  return true;
}

int feed(char** args) {
  std::ifstream scans(args[0], std::ios::binary);
  if (!scans) {
    std::fprintf(stderr, "cannot read %s\n", args[0]);
    return 1;
  }
  const bool by_keys = std::strcmp(args[2], "keys") == 0;
  const double range = std::atof(args[4]);
  OcTree tree(std::atof(args[3]));
  tree.enableChangeDetection(by_keys);

  const int node = socket(AF_INET, SOCK_STREAM, 0);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(std::atoi(args[1]));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  if (connect(node, reinterpret_cast<sockaddr*>(&address), sizeof address) != 0) {
    std::perror("cannot reach the node");
    return 1;
  }
  octomap::Pointcloud cloud;
  octomap::point3d sensor;
  unsigned count = 0;
  while (read_scan(scans, cloud, sensor)) {
    tree.insertPointCloud(cloud, sensor, range);
    count++;
    if (by_keys) send_changed_keys(tree, sensor, node);
    else if (count % 5 == 0) send_box(tree, sensor, range + 1.0, node);
    usleep(20000);
  }
  if (!by_keys) send_box(tree, sensor, range + 1.0, node);
  close(node);
  if (!tree.writeBinary(args[5])) return 1;
  std::printf("%u scans mapped by OctoMap and sent as %s\n", count, args[2]);
  return 0;
}

using Voxels = std::map<Voxel, State>;

Voxels read_tree(const char* path) {
  // `readBinary` takes the resolution from the file.
  OcTree tree(1.0);
  if (!tree.readBinary(path)) {
    std::fprintf(stderr, "cannot read %s\n", path);
    std::exit(1);
  }
  Voxels voxels;
  for (auto leaf = tree.begin_leafs(); leaf != tree.end_leafs(); ++leaf)
    each_voxel(leaf, [&](const Voxel& voxel) { voxels[voxel] = state_of(tree, &*leaf); });
  return voxels;
}

int check(int count, char** paths) {
  const Voxels expected = read_tree(paths[0]);
  bool is_equal = true;
  for (int i = 1; i < count; i++) {
    const Voxels got = read_tree(paths[i]);
    size_t differ = 0, only_here = 0;
    for (const auto& [voxel, state] : expected) {
      const auto found = got.find(voxel);
      differ += found == got.end() || found->second != state;
    }
    for (const auto& entry : got) only_here += expected.count(entry.first) == 0;
    std::printf("%s: %zu voxels, OctoMap has %zu; %zu differ, %zu only here\n", paths[i], got.size(), expected.size(),
                differ, only_here);
    is_equal = is_equal && differ + only_here == 0 && !expected.empty();
  }
  return is_equal ? 0 : 1;
}

int main(int count, char** args) {
  if (count == 8 && std::strcmp(args[1], "feed") == 0) return feed(args + 2);
  if (count >= 4 && std::strcmp(args[1], "check") == 0) return check(count - 2, args + 2);
  std::fprintf(stderr,
               "usage: octomap_feed feed SCANS PORT keys|box RESOLUTION RANGE TREE.bt\n"
               "       octomap_feed check TREE.bt MAP.bt ...\n");
  return 2;
}
