// Follows the map of a node until the node ends, and compares what it has with the map that the node saved, voxel by voxel.
//
//   mirror_check ADDRESS MAP.ply [--origins]
//
// exit: 0 they are equal; 1 they differ; 2 what was given is wrong. MAP.ply is read after the node has ended; it must have
// free voxels too (save_free). Reads the file itself, so that nothing of this is Rust.
#include <cstdio>
#include <fstream>
#include <map>

#include "flockmap_mirror_client.hpp"

using namespace flockmap_mirror;

namespace {

constexpr auto kPatience = std::chrono::minutes(20);

using Voxels = std::map<Index, State>;

// A binary .ply with x, y, z as float or double, red, green, blue and state.
Voxels read_ply(const std::string& path, double side) {
    std::ifstream file(path, std::ios::binary);
    std::string line;
    std::size_t count = 0, width = 0, numbers = 0;
    bool is_double = false, is_little = false;
    while (std::getline(file, line) && line != "end_header") {
        if (line == "format binary_little_endian 1.0") {
            is_little = true;
        } else if (line.rfind("element vertex ", 0) == 0) {
            count = std::stoull(line.substr(15));
        } else if (line.rfind("property double ", 0) == 0) {
            width += 8;
            is_double = true;
            ++numbers;
        } else if (line.rfind("property float ", 0) == 0) {
            width += 4;
            ++numbers;
        } else if (line.rfind("property uchar ", 0) == 0) {
            width += 1;
        }
    }
    if (line != "end_header" || !is_little || numbers != 3 || width != (is_double ? 28u : 16u)) {
        throw std::runtime_error(path + " is no map that a node saved with save_free");
    }
    Voxels voxels;
    std::string row(width, '\0');
    for (std::size_t i = 0; i < count; ++i) {
        if (!file.read(row.data(), static_cast<std::streamsize>(width))) {
            throw std::runtime_error(path + " ends before its last voxel");
        }
        std::array<std::int32_t, 3> at{};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            double metres = 0;
            if (is_double) {
                std::memcpy(&metres, row.data() + 8 * axis, 8);
            } else {
                float number;
                std::memcpy(&number, row.data() + 4 * axis, 4);
                metres = static_cast<double>(number);
            }
            at[axis] = static_cast<std::int32_t>(std::floor(metres / side));
        }
        voxels[{at[0], at[1], at[2]}] = row.back() == 1 ? State::Occupied : State::Free;
    }
    return voxels;
}

int follow(const std::string& address, const std::string& path, bool wants_origins) {
    ClientOptions options;
    options.mirror.wants_origins = wants_origins;
    Client client(address, options);
    const auto began = std::chrono::steady_clock::now();
    int anew = 0;
    // The node says that it ends; where the connection only breaks, the client comes back.
    while (client.wait(100)) {
        const auto& mirror = client.mirror();
        if (mirror.end() && *mirror.end() != "" && !client.is_connected()) {
            break;
        }
        if (std::chrono::steady_clock::now() - began > kPatience) {
            std::fprintf(stderr, "no end after 20 minutes; %s\n", client.error().c_str());
            return 1;
        }
        anew += mirror.is_caught_up();
    }
    const auto& mirror = client.mirror();
    std::printf("%s; version %llu of %llu, %zu blocks, caught up %d times\n", client.error().c_str(),
                static_cast<unsigned long long>(mirror.version()), static_cast<unsigned long long>(mirror.newest()),
                mirror.map().blocks().size(), anew);
    Voxels own;
    mirror.map().for_each([&](const Index& voxel, State state) { own[voxel] = state; });
    // The file is written once the feed has ended.
    Voxels saved;
    for (int tries = 0;; ++tries) {
        try {
            saved = read_ply(path, mirror.map().resolution_m());
            break;
        } catch (const std::exception& error) {
            if (tries == 300) {
                throw;
            }
            ::poll(nullptr, 0, 100);
        }
    }
    std::size_t differ = 0;
    for (const auto& [voxel, state] : saved) {
        const auto found = own.find(voxel);
        differ += found == own.end() || found->second != state;
    }
    for (const auto& [voxel, state] : own) {
        differ += saved.find(voxel) == saved.end();
    }
    std::printf("%zu voxels here, %zu in %s, %zu differ\n", own.size(), saved.size(), path.c_str(), differ);
    return differ == 0 && mirror.version() == mirror.newest() && !own.empty() ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
    const bool wants_origins = argc == 4 && std::string(argv[3]) == "--origins";
    if (argc != 3 && !wants_origins) {
        std::fprintf(stderr, "usage: mirror_check ADDRESS MAP.ply [--origins]\n");
        return 2;
    }
    try {
        return follow(argv[1], argv[2], wants_origins);
    } catch (const std::exception& error) {
        std::fprintf(stderr, "%s\n", error.what());
        return 2;
    }
}
