// An OctoMap fed in: a program that maps with OctoMap gives the voxels that changed to a robot, which tells the others. In the
// end both maps are the same.
#include <octomap/OcTree.h>

#include <cmath>
#include <cstdio>
#include <stdexcept>

#include "flockmap.hpp"

namespace {

constexpr double kSide = 0.1;
// The key of the voxel that begins at 0.
constexpr std::int32_t kMiddle = 1 << 15;

// What the octree says of a voxel.
std::uint8_t state_of(const octomap::OcTree& tree, const octomap::OcTreeKey& key) {
    const octomap::OcTreeNode* node = tree.search(key);
    if (node == nullptr) {
        return FLOCKMAP_VOXEL_STATE_UNKNOWN;
    }
    return tree.isNodeOccupied(node) ? FLOCKMAP_VOXEL_STATE_OCCUPIED : FLOCKMAP_VOXEL_STATE_FREE;
}

// A round room of 3 m about the origin, seen from a place in it.
octomap::Pointcloud look_around(const octomap::point3d& from) {
    octomap::Pointcloud cloud;
    for (int degree = 0; degree < 360; degree += 2) {
        const double angle = degree * 3.14159265358979 / 180.0;
        for (int z = -5; z <= 5; ++z) {
            cloud.push_back(static_cast<float>(3.0 * std::cos(angle)), static_cast<float>(3.0 * std::sin(angle)),
                            from.z() + static_cast<float>(z) * 0.1f);
        }
    }
    return cloud;
}

void run() {
    octomap::OcTree tree(kSide);
    tree.enableChangeDetection(true);
    auto options = flockmap::default_options();
    options.resolution_m = kSide;
    flockmap::Robot robot(options, 0);
    std::size_t given = 0;
    for (int scan = 0; scan < 10; ++scan) {
        const std::int64_t now = 100'000 * (scan + 1);
        const octomap::point3d sensor(0.1f * static_cast<float>(scan), 0.0f, 0.0f);
        tree.insertPointCloud(look_around(sensor), sensor);
        std::vector<std::int32_t> voxels;
        std::vector<std::uint8_t> states;
        for (auto changed = tree.changedKeysBegin(); changed != tree.changedKeysEnd(); ++changed) {
            for (unsigned axis = 0; axis < 3; ++axis) {
                voxels.push_back(static_cast<std::int32_t>(changed->first[axis]) - kMiddle);
            }
            states.push_back(state_of(tree, changed->first));
        }
        tree.resetChangeDetection();
        const flockmap::Point at{sensor.x(), sensor.y(), sensor.z()};
        robot.insert_states(now, now, kSide, voxels, states, &at);
        given += states.size();
    }
    // Voxel by voxel, in both directions.
    tree.expand();
    const auto view = robot.view();
    std::size_t leaves = 0;
    for (auto leaf = tree.begin_leafs(); leaf != tree.end_leafs(); ++leaf, ++leaves) {
        const octomap::OcTreeKey key = leaf.getKey();
        const std::int32_t voxel[3] = {key[0] - kMiddle, key[1] - kMiddle, key[2] - kMiddle};
        std::uint8_t state = 0;
        view.voxel_states(voxel, {&state, 1});
        if (state != state_of(tree, key)) {
            throw std::runtime_error("the maps differ");
        }
    }
    const auto info = view.info();
    std::printf("%zu changes of the octree made %zu free and %zu occupied voxels; it has %zu leaves\n", given, info.free,
                info.occupied, leaves);
    if (info.free + info.occupied != leaves || info.occupied == 0) {
        throw std::runtime_error("one map has more voxels than the other");
    }
}

}  // namespace

int main() {
    try {
        run();
    } catch (const std::exception& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 1;
    }
    return 0;
}
