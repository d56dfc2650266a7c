// Flockmap for C++17: flockmap.h with ownership, spans and exceptions. Header only.
//
// - Handles are move-only objects that free themselves. Views and frontiers never change and outlive their robot.
// - Arrays come as spans: a vector, a std::array or a C array of numbers, with x, y, z of one point after those of the
//   other, or pointer and size. A length that does not fit is an Error.
// - Errors are exceptions of the type flockmap::Error, thrown on this side only: nothing is thrown through C.
// - Threads: as in flockmap.h. Any thread may call any method; nobody may use an object while it is moved or destroyed.
// - Coordinates are metres in the frame of the robot's map, times are microseconds on the robot's clock.
#ifndef FLOCKMAP_HPP
#define FLOCKMAP_HPP

#include <array>
#include <cstddef>
#include <cstdint>
#include <iterator>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <type_traits>
#include <utility>
#include <vector>

#include "flockmap.h"

namespace flockmap {

// An error of the library: what() says which function, what was wrong and what to do.
class Error : public std::runtime_error {
public:
    Error(flockmap_result code, const std::string& text) : std::runtime_error(text), code_(code) {}
    flockmap_result code() const noexcept { return code_; }

private:
    flockmap_result code_;
};

// A pointer and how many elements there are: std::span of C++20, as far as it is needed here.
template <class T>
class Span {
public:
    constexpr Span() noexcept = default;
    constexpr Span(T* data, std::size_t size) noexcept : data_(data), size_(size) {}
    // Anything with data() and size(), of elements of this very type.
    template <class Container,
              class = std::enable_if_t<std::is_convertible_v<
                  std::remove_pointer_t<decltype(std::data(std::declval<Container&>()))> (*)[], T (*)[]>>>
    constexpr Span(Container&& elements) noexcept : data_(std::data(elements)), size_(std::size(elements)) {}

    constexpr T* data() const noexcept { return data_; }
    constexpr std::size_t size() const noexcept { return size_; }

private:
    T* data_ = nullptr;
    std::size_t size_ = 0;
};

using Pose = std::array<double, 16>;  // 4 x 4, row by row: T_a_b takes a point in frame b to frame a
using Point = std::array<double, 3>;
using Voxel = std::array<std::int32_t, 3>;
using Box = flockmap_box;

enum class State : std::uint8_t { Unknown = 0, Free = 1, Occupied = 2 };
enum class Obstacles : std::int32_t { Occupied = 0, NotFree = 1 };
enum class ColumnRule : std::int32_t { AnyFree = 0, AllFree = 1 };
enum class Updated : std::int32_t { Unchanged = 0, Partly = 1, Anew = 2 };

constexpr Pose identity() noexcept { return {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1}; }

// A pose that is not turned.
constexpr Pose at(double x, double y, double z) noexcept { return {1, 0, 0, x, 0, 1, 0, y, 0, 0, 1, z, 0, 0, 0, 1}; }

namespace detail {

// Throws if a result is an error. True if there was something, false for FLOCKMAP_NONE.
inline bool check(flockmap_result result) {
    if (result < 0) {
        throw Error(result, flockmap_last_error());
    }
    return result == FLOCKMAP_OK;
}

// How many times N numbers these are.
template <std::size_t N, class T>
std::size_t rows(Span<T> numbers, const char* what) {
    if (numbers.size() % N != 0) {
        throw Error(FLOCKMAP_ERROR_ARGUMENT, std::string(what) + " has " + std::to_string(numbers.size()) +
                                                 " numbers, expected " + std::to_string(N) + " for each");
    }
    return numbers.size() / N;
}

inline void same(std::size_t got, std::size_t expected, const char* what) {
    if (got != expected) {
        throw Error(FLOCKMAP_ERROR_ARGUMENT,
                    std::string(what) + " has " + std::to_string(got) + " elements, expected " + std::to_string(expected));
    }
}

// The list that a function writes, which is asked for its length first.
template <class T, class Ask>
std::vector<T> list(Ask&& ask) {
    std::size_t count = 0;
    check(ask(static_cast<T*>(nullptr), std::size_t{0}, &count));
    std::vector<T> all(count);
    check(ask(all.data(), all.size(), &count));
    return all;
}

template <auto Free>
struct Deleter {
    template <class T>
    void operator()(T* handle) const noexcept {
        Free(handle);
    }
};

}  // namespace detail

// The voxels between two corners in metres.
inline Box box_between(double resolution_m, const Point& low_m, const Point& high_m) {
    Box box;
    detail::check(flockmap_box_between(resolution_m, low_m.data(), high_m.data(), &box));
    return box;
}

inline std::size_t volume(const Box& box) noexcept {
    return std::size_t{box.size[0]} * box.size[1] * box.size[2];
}

// A map as it was at one moment.
class View {
public:
    // A map of which nothing is known.
    explicit View(double resolution_m) {
        flockmap_view* view = nullptr;
        detail::check(flockmap_view_new(resolution_m, &view));
        view_.reset(view);
    }
    // Takes the handle over.
    explicit View(flockmap_view* view) noexcept : view_(view) {}

    // From a file, by its ending: .bt .ply .pcd .las .laz
    static View load(const std::string& path, double resolution_m = 0.1) {
        flockmap_view* view = nullptr;
        detail::check(flockmap_view_load(path.c_str(), resolution_m, &view));
        return View(view);
    }

    // Writes .bt, .ply or .pcd; says how many voxels.
    std::uint64_t save(const std::string& path, bool with_free = false) const {
        std::uint64_t voxels = 0;
        detail::check(flockmap_view_save(get(), path.c_str(), with_free, &voxels));
        return voxels;
    }

    // Another view in which these blocks are replaced: 3 numbers and 2 times 8 words for each.
    View with_blocks(Span<const std::int32_t> indices, Span<const std::uint64_t> free,
                     Span<const std::uint64_t> occupied) const {
        const std::size_t count = detail::rows<3>(indices, "indices");
        detail::same(free.size() / 8, count, "free");
        detail::same(occupied.size() / 8, count, "occupied");
        flockmap_view* view = nullptr;
        detail::check(
            flockmap_view_with_blocks(get(), indices.data(), free.data(), occupied.data(), count, &view));
        return View(view);
    }

    flockmap_view_summary info() const {
        flockmap_view_summary info;
        detail::check(flockmap_view_info(get(), &info));
        return info;
    }

    // Empty if nothing is known.
    std::optional<Box> bounds() const {
        Box box;
        return detail::check(flockmap_view_bounds(get(), &box)) ? std::optional<Box>(box) : std::nullopt;
    }

    State state_at(const Point& point) const {
        std::uint8_t state = 0;
        detail::check(flockmap_view_states(get(), point.data(), 1, &state));
        return static_cast<State>(state);
    }

    // x, y, z of each point in; a state for each out.
    void states(Span<const double> points, Span<std::uint8_t> states) const {
        const std::size_t count = detail::rows<3>(points, "points");
        detail::same(states.size(), count, "states");
        detail::check(flockmap_view_states(get(), points.data(), count, states.data()));
    }

    void voxel_states(Span<const std::int32_t> voxels, Span<std::uint8_t> states) const {
        const std::size_t count = detail::rows<3>(voxels, "voxels");
        detail::same(states.size(), count, "states");
        detail::check(flockmap_view_voxel_states(get(), voxels.data(), count, states.data()));
    }

    struct Block {
        std::array<std::uint64_t, 8> free, occupied;
    };

    std::optional<Block> block(const Voxel& index) const {
        Block block;
        const auto result = flockmap_view_block(get(), index.data(), block.free.data(), block.occupied.data());
        return detail::check(result) ? std::optional<Block>(block) : std::nullopt;
    }

    // Indices of blocks, 3 numbers each; empty if everything may have changed.
    std::optional<std::vector<std::int32_t>> changed_since(std::uint64_t version) const {
        std::size_t count = 0;
        if (!detail::check(flockmap_view_changed_since(get(), version, nullptr, 0, &count))) {
            return std::nullopt;
        }
        std::vector<std::int32_t> indices(3 * count);
        detail::check(flockmap_view_changed_since(get(), version, indices.data(), count, &count));
        return indices;
    }

    // Indices of the voxels of a state, ascending; of a box, or of all of the map.
    std::vector<Voxel> voxels(State state, const Box* region = nullptr) const {
        return detail::list<Voxel>([&](Voxel* to, std::size_t room, std::size_t* count) {
            return flockmap_view_voxels(get(), region, static_cast<std::int32_t>(state), numbers(to), room, count);
        });
    }

    // Centres of the occupied voxels in metres.
    std::vector<std::array<float, 3>> occupied_points(const Box* region = nullptr) const {
        return detail::list<std::array<float, 3>>([&](std::array<float, 3>* to, std::size_t room, std::size_t* count) {
            return flockmap_view_occupied_points(get(), region, numbers(to), room, count);
        });
    }

    std::vector<flockmap_ray_hit> cast_rays(Span<const double> from, Span<const double> to,
                                            bool through_unknown) const {
        const std::size_t count = detail::rows<3>(from, "from");
        detail::same(to.size(), from.size(), "to");
        std::vector<flockmap_ray_hit> hits(count);
        detail::check(
            flockmap_view_cast_rays(get(), from.data(), to.data(), count, through_unknown, hits.data()));
        return hits;
    }

    // 1 for each sphere that meets an obstacle, else 0.
    std::vector<std::uint8_t> spheres(Obstacles obstacles, Span<const double> centres, double radius_m) const {
        std::vector<std::uint8_t> collides(detail::rows<3>(centres, "centres"));
        detail::check(flockmap_view_spheres(get(), static_cast<std::int32_t>(obstacles), centres.data(),
                                            collides.size(), radius_m, collides.data()));
        return collides;
    }

    // Metres to the first obstacle on each straight way of a sphere, infinity if there is none.
    std::vector<double> segments(Obstacles obstacles, Span<const double> from, Span<const double> to,
                                 double radius_m) const {
        std::vector<double> along(detail::rows<3>(from, "from"));
        detail::same(to.size(), from.size(), "to");
        detail::check(flockmap_view_segments(get(), static_cast<std::int32_t>(obstacles), from.data(), to.data(),
                                             along.size(), radius_m, along.data(), nullptr));
        return along;
    }

    // -1, 0 or 100 for each column, row by row.
    std::vector<std::int8_t> occupancy_grid(const Box& band, ColumnRule rule) const {
        std::vector<std::int8_t> cells(columns(band));
        detail::check(flockmap_view_occupancy_grid(get(), &band, static_cast<std::int32_t>(rule), cells.data(),
                                                   cells.size()));
        return cells;
    }

    struct Heights {
        std::vector<float> bottoms_m, tops_m;
    };

    // NaN where a column has no obstacle.
    Heights height_map(const Box& region) const {
        const std::size_t cells = columns(region);
        Heights heights{std::vector<float>(cells), std::vector<float>(cells)};
        detail::check(flockmap_view_height_map(get(), &region, heights.bottoms_m.data(), heights.tops_m.data(),
                                               cells));
        return heights;
    }

    const flockmap_view* get() const noexcept { return view_.get(); }

private:
    template <class T, std::size_t N>
    static T* numbers(std::array<T, N>* rows) noexcept {
        return rows == nullptr ? nullptr : rows->data();
    }

    // A box of more cells than a product may have is refused before there is memory for it.
    static std::size_t columns(const Box& box) {
        const std::uint64_t cells = std::uint64_t{box.size[0]} * box.size[1];
        if (cells > (std::uint64_t{1} << 26)) {
            throw Error(FLOCKMAP_ERROR_TOO_LARGE,
                        std::to_string(cells) + " columns, expected at most 2^26: take a smaller part of the map");
        }
        return static_cast<std::size_t>(cells);
    }

    std::unique_ptr<flockmap_view, detail::Deleter<flockmap_view_free>> view_;
};

// How far the nearest obstacle of a box is, for each voxel of it.
class Field {
public:
    // memory_max in bytes; 0: 256 MiB.
    Field(const View& view, const Box& region, Obstacles obstacles, std::uint64_t memory_max = 0) {
        flockmap_field* field = nullptr;
        detail::check(flockmap_field_new(view.get(), &region, static_cast<std::int32_t>(obstacles), memory_max, &field));
        field_.reset(field);
    }

    Updated update(const View& view) {
        std::int32_t did = 0;
        detail::check(flockmap_field_update(field_.get(), view.get(), &did));
        return static_cast<Updated>(did);
    }

    void move_to(const View& view, const Box& region) {
        detail::check(flockmap_field_move_to(field_.get(), view.get(), &region));
    }

    Box box() const {
        Box box;
        detail::check(flockmap_field_box(field_.get(), &box));
        return box;
    }

    struct Near {
        double distance_m;
        Point gradient;
    };

    // NaN outside of the box.
    Near at(const Point& point) const {
        Near near;
        detail::check(flockmap_field_at(field_.get(), point.data(), 1, &near.distance_m, near.gradient.data()));
        return near;
    }

    // gradients: 3 numbers for each point, or empty.
    void at(Span<const double> points, Span<double> distances_m, Span<double> gradients = {}) const {
        const std::size_t count = detail::rows<3>(points, "points");
        detail::same(distances_m.size(), count, "distances_m");
        if (gradients.size() != 0) {
            detail::same(gradients.size(), points.size(), "gradients");
        }
        detail::check(flockmap_field_at(field_.get(), points.data(), count, distances_m.data(),
                                        gradients.size() == 0 ? nullptr : gradients.data()));
    }

    std::vector<std::uint8_t> are_clear(Span<const double> centres, double radius_m) const {
        std::vector<std::uint8_t> clear(detail::rows<3>(centres, "centres"));
        detail::check(flockmap_field_are_clear(field_.get(), centres.data(), clear.size(), radius_m, clear.data()));
        return clear;
    }

    // Of all voxels: x fastest, then y, then z.
    std::vector<float> array() const {
        std::vector<float> distances(volume(box()));
        detail::check(flockmap_field_array(field_.get(), distances.data(), distances.size()));
        return distances;
    }

private:
    std::unique_ptr<flockmap_field, detail::Deleter<flockmap_field_free>> field_;
};

struct Frontier {
    Point centroid_m;
    Box bounds;
    std::vector<Voxel> voxels;
};

// Free voxels beside Unknown ones, in clusters.
inline std::vector<Frontier> frontiers(const View& view, const Box& region, double reach_m = 1.5,
                                       std::size_t voxels_min = 6) {
    flockmap_frontiers* handle = nullptr;
    detail::check(flockmap_frontiers_new(view.get(), &region, reach_m, voxels_min, &handle));
    const std::unique_ptr<flockmap_frontiers, detail::Deleter<flockmap_frontiers_free>> found(handle);
    std::size_t count = 0;
    detail::check(flockmap_frontiers_count(found.get(), &count));
    std::vector<Frontier> all;
    for (std::size_t at = 0; at < count; ++at) {
        flockmap_frontier info;
        detail::check(flockmap_frontiers_get(found.get(), at, &info));
        Frontier one{{info.centroid_m[0], info.centroid_m[1], info.centroid_m[2]}, info.bounds, {}};
        one.voxels.resize(info.voxels);
        std::size_t voxels = 0;
        detail::check(flockmap_frontiers_voxels(
            found.get(), at, one.voxels.empty() ? nullptr : one.voxels.data()->data(), one.voxels.size(), &voxels));
        all.push_back(std::move(one));
    }
    return all;
}

inline flockmap_robot_options default_options() {
    flockmap_robot_options options;
    detail::check(flockmap_robot_options_default(&options));
    return options;
}

// A datagram to send, and where to.
struct Datagram {
    flockmap_transmit to;
    std::vector<std::uint8_t> bytes;
};

// A robot of the swarm.
class Robot {
public:
    Robot(const flockmap_robot_options& options, std::int64_t now_us) {
        flockmap_robot* robot = nullptr;
        detail::check(flockmap_robot_new(&options, now_us, &robot));
        robot_.reset(robot);
    }

    // From the text of a node's configuration. epoch 0: made of the system's clock and random bits.
    static Robot from_toml(const std::string& toml, std::int64_t now_us, std::uint64_t epoch = 0) {
        if (toml.find('\0') != std::string::npos) {
            throw Error(FLOCKMAP_ERROR_ARGUMENT, "toml has a character 0, which would end it");
        }
        flockmap_robot* robot = nullptr;
        detail::check(flockmap_robot_new_from_toml(toml.c_str(), epoch, now_us, &robot));
        return Robot(robot);
    }

    // points and no_returns: x, y, z of each in metres, in the frame of the sensor.
    flockmap_scan_report insert_scan(std::int64_t now_us, std::int64_t stamp_us, Span<const float> points,
                                     const Pose& T_map_sensor, Span<const float> no_returns = {}) {
        flockmap_scan_report report;
        const std::size_t count = detail::rows<3>(points, "points");
        const std::size_t without = detail::rows<3>(no_returns, "no_returns");
        detail::check(flockmap_robot_insert_scan(get(), now_us, stamp_us, points.data(), count, no_returns.data(),
                                                 without, T_map_sensor.data(), &report));
        return report;
    }

    // Single voxels of a mapper elsewhere. sensor: where it was, or null.
    flockmap_scan_report insert_states(std::int64_t now_us, std::int64_t stamp_us, double resolution_m,
                                       Span<const std::int32_t> voxels, Span<const std::uint8_t> states,
                                       const Point* sensor = nullptr) {
        flockmap_scan_report report;
        detail::same(states.size(), detail::rows<3>(voxels, "voxels"), "states");
        detail::check(flockmap_robot_insert_states(get(), now_us, stamp_us, resolution_m,
                                                   sensor == nullptr ? nullptr : sensor->data(), voxels.data(),
                                                   states.data(), states.size(), &report));
        return report;
    }

    // All voxels of a box, x fastest.
    flockmap_scan_report insert_box(std::int64_t now_us, std::int64_t stamp_us, double resolution_m, const Box& box,
                                    Span<const std::uint8_t> states, bool clear_unknown,
                                    const Point* sensor = nullptr) {
        flockmap_scan_report report;
        detail::check(flockmap_robot_insert_box(get(), now_us, stamp_us, resolution_m,
                                                sensor == nullptr ? nullptr : sensor->data(), box.low, box.size,
                                                states.data(), states.size(), clear_unknown, &report));
        return report;
    }

    // False if the datagram was damaged, foreign or forged: that is counted, and needs no action.
    bool handle_datagram(std::int64_t now_us, Span<const std::uint8_t> bytes) {
        return taken(flockmap_robot_handle_datagram(get(), now_us, bytes.data(), bytes.size()));
    }

    // path: a number for the address that it came from.
    bool handle_datagram_from(std::int64_t now_us, std::uint64_t path, Span<const std::uint8_t> bytes) {
        return taken(flockmap_robot_handle_datagram_from(get(), now_us, path, bytes.data(), bytes.size()));
    }

    void handle_timeout(std::int64_t now_us) { detail::check(flockmap_robot_handle_timeout(get(), now_us)); }

    std::optional<std::int64_t> poll_timeout() const {
        std::int64_t due = 0;
        return detail::check(flockmap_robot_poll_timeout(get(), &due)) ? std::optional<std::int64_t>(due)
                                                                       : std::nullopt;
    }

    // The next datagram; empty if there is none.
    std::optional<Datagram> poll_transmit(std::int64_t now_us) {
        Datagram next{{}, std::vector<std::uint8_t>(FLOCKMAP_DATAGRAM_BYTES_MAX)};
        if (!detail::check(flockmap_robot_poll_transmit(get(), now_us, next.bytes.data(), next.bytes.size(), &next.to))) {
            return std::nullopt;
        }
        next.bytes.resize(next.to.length);
        return next;
    }

    std::optional<flockmap_event> poll_event() {
        flockmap_event event;
        return detail::check(flockmap_robot_poll_event(get(), &event)) ? std::optional<flockmap_event>(event)
                                                                       : std::nullopt;
    }

    void flush(std::int64_t now_us) { detail::check(flockmap_robot_flush(get(), now_us)); }

    std::size_t unpublished() const {
        std::size_t voxels = 0;
        detail::check(flockmap_robot_unpublished(get(), &voxels));
        return voxels;
    }

    void set_alignment(std::uint16_t origin, const Pose& T_own_origin) {
        detail::check(flockmap_robot_set_alignment(get(), origin, T_own_origin.data()));
    }
    // The number of the submap that begins: what is seen from now on moves with it.
    std::uint16_t begin_submap(std::int64_t now_us) {
        std::uint16_t submap = 0;
        detail::check(flockmap_robot_begin_submap(get(), now_us, &submap));
        return submap;
    }
    // How a submap of this run lies in the map now, as after a closed loop; nothing of it is sent again.
    void set_submap_pose(std::int64_t now_us, std::uint16_t submap, const Pose& T_map_submap) {
        detail::check(flockmap_robot_set_submap_pose(get(), now_us, submap, T_map_submap.data()));
    }
    // How far the clock of a robot is ahead; empty: measure it again.
    void set_clock_offset(std::uint16_t origin, std::optional<std::int64_t> ahead_us) {
        detail::check(flockmap_robot_set_clock_offset(get(), origin, ahead_us.value_or(0), !ahead_us));
    }
    void set_muted(std::uint16_t origin, bool is_muted) {
        detail::check(flockmap_robot_set_muted(get(), origin, is_muted));
    }
    void set_teammate(std::uint16_t id, const Point& position_m, std::int64_t seen_us) {
        detail::check(flockmap_robot_set_teammate(get(), id, position_m.data(), seen_us));
    }

    flockmap_counters counters() const {
        flockmap_counters counters;
        detail::check(flockmap_robot_counters(get(), &counters));
        return counters;
    }

    // Retried where a layer came in between the two questions.
    std::vector<flockmap_layer> layers() const {
        for (;;) {
            std::size_t count = 0;
            detail::check(flockmap_robot_layers(get(), nullptr, 0, &count));
            std::vector<flockmap_layer> layers(count + 4);
            const auto result = flockmap_robot_layers(get(), layers.data(), layers.size(), &count);
            if (result != FLOCKMAP_ERROR_BUFFER) {
                detail::check(result);
                layers.resize(count);
                return layers;
            }
        }
    }

    View view() const {
        flockmap_view* view = nullptr;
        detail::check(flockmap_robot_view(get(), &view));
        return View(view);
    }

    flockmap_robot* get() const noexcept { return robot_.get(); }

private:
    explicit Robot(flockmap_robot* robot) noexcept : robot_(robot) {}

    static bool taken(flockmap_result result) {
        return result != FLOCKMAP_ERROR_DATAGRAM && detail::check(result);
    }

    std::unique_ptr<flockmap_robot, detail::Deleter<flockmap_robot_free>> robot_;
};

}  // namespace flockmap

#endif
