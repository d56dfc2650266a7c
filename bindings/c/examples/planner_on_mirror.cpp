// An A* that plans on a mirror of a node's map while it grows: at each moment the way home, from where the robot is to where it
// was first seen, through voxels that are known to be free. Needs neither libflockmap nor Rust.
//
//   planner_on_mirror unix:map.sock        until the node ends
//
// exit: 0 if it found a way on a map that had grown in between, 1 else.
#include <chrono>
#include <cstdio>
#include <queue>

#include "flockmap_mirror_client.hpp"

using namespace flockmap_mirror;

namespace {

constexpr std::size_t kCellsMax = 2'000'000;  // looked at by one search
constexpr auto kPatience = std::chrono::minutes(5);

double length(const Index& a, const Index& b) {
    const double x = a.x - b.x, y = a.y - b.y, z = a.z - b.z;
    return std::sqrt(x * x + y * y + z * z);
}

// The shortest way from one voxel to another through free ones, 26 neighbours each; empty if there is none. All that it looks
// at is one state of the map: the mirror takes nothing in meanwhile.
std::vector<Index> plan(const Map& map, const Index& start, const Index& goal) {
    struct Visit {
        double estimate;
        Index at;
        bool operator<(const Visit& other) const { return estimate > other.estimate; }
    };
    struct Reached {
        double cost;
        Index from;
    };
    std::unordered_map<Index, Reached, IndexHash> reached{{start, {0.0, start}}};
    std::priority_queue<Visit> open;
    open.push({length(start, goal), start});
    while (!open.empty() && reached.size() < kCellsMax) {
        const auto [estimate, at] = open.top();
        open.pop();
        const double cost = reached.at(at).cost;
        if (at == goal) {
            std::vector<Index> path{goal};
            while (!(path.back() == start)) {
                path.push_back(reached.at(path.back()).from);
            }
            return {path.rbegin(), path.rend()};
        }
        if (estimate > cost + length(at, goal) + 1e-9) {
            continue;  // reached on a shorter way since
        }
        for (int step = 0; step < 27; ++step) {
            const Index next{at.x + step % 3 - 1, at.y + step / 3 % 3 - 1, at.z + step / 9 - 1};
            if (step == 13 || map.state(next) != State::Free) {
                continue;
            }
            const double next_cost = cost + length(at, next);
            const auto [old, is_new] = reached.try_emplace(next, Reached{next_cost, at});
            if (!is_new && old->second.cost <= next_cost) {
                continue;
            }
            old->second = {next_cost, at};
            open.push({next_cost + length(next, goal), next});
        }
    }
    return {};
}

}  // namespace

int main(int argc, char** argv) {
    if (argc != 2) {
        std::fprintf(stderr, "usage: planner_on_mirror unix:PATH | HOST:PORT\n");
        return 2;
    }
    ClientOptions options;
    options.reconnects = false;
    Client client(argv[1], options);
    const Mirror& mirror = client.mirror();
    const auto began = std::chrono::steady_clock::now();
    std::optional<Index> home;
    std::uint64_t planned_on = 0;
    std::size_t blocks_at_first = 0, blocks_at_last = 0;
    int plans = 0, ways = 0;
    double longest_m = 0;
    while (client.wait(100)) {
        if (std::chrono::steady_clock::now() - began > kPatience) {
            std::fprintf(stderr, "the node has not ended after 5 minutes; %s\n", client.error().c_str());
            return 1;
        }
        // Only on a map that is the node's of one moment, and has changed.
        if (!mirror.is_caught_up() || mirror.changes() == planned_on || mirror.robots().empty()) {
            continue;
        }
        const auto& position = mirror.robots()[0].position_m;
        const auto here = mirror.map().voxel_at(position[0], position[1], position[2]);
        // The sensor's own voxel may not have been seen yet.
        if (!here || mirror.map().state(*here) != State::Free) {
            continue;
        }
        planned_on = mirror.changes();
        home = home.value_or(*here);
        const auto path = plan(mirror.map(), *here, *home);
        ++plans;
        if (path.empty()) {
            continue;
        }
        double way = 0;
        for (std::size_t i = 0; i < path.size(); ++i) {
            if (mirror.map().state(path[i]) != State::Free) {
                std::fprintf(stderr, "the way leads through what is not free\n");
                return 1;
            }
            way += i > 0 ? length(path[i - 1], path[i]) : 0;
        }
        const double side = mirror.map().resolution_m();
        if (way + 1e-9 < length(*here, *home)) {
            std::fprintf(stderr, "the way is shorter than the straight line\n");
            return 1;
        }
        if (way * side > longest_m + 1.0) {
            longest_m = way * side;
            std::printf("version %llu, %zu blocks: %.1f m home through %zu voxels, %.1f m straight\n",
                        static_cast<unsigned long long>(mirror.version()), mirror.map().blocks().size(), way * side,
                        path.size(), length(*here, *home) * side);
        }
        blocks_at_first = ways == 0 ? mirror.map().blocks().size() : blocks_at_first;
        blocks_at_last = mirror.map().blocks().size();
        ++ways;
    }
    std::printf("%s. %d plans, %d ways home, on maps of %zu to %zu blocks\n", client.error().c_str(), plans, ways,
                blocks_at_first, blocks_at_last);
    return ways > 1 && longest_m > 0 && blocks_at_last > blocks_at_first ? 0 : 1;
}
