// Wrong inputs: each is a clear error, and nothing is lost.
#include <cmath>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <random>

#include "check.hpp"
#include "flockmap.hpp"

namespace {

const double kNan = std::nan("");
const double kInfinity = std::numeric_limits<double>::infinity();

template <class Call>
bool fails(flockmap_result code, const char* text, Call&& call) {
    try {
        call();
    } catch (const flockmap::Error& error) {
        if (error.code() == code && std::strstr(error.what(), text) != nullptr) {
            return true;
        }
        throw std::logic_error(std::string("another error: ") + flockmap_result_name(error.code()) + ": " + error.what());
    }
    throw std::logic_error(std::string("no error: expected ") + text);
}

flockmap::Robot robot() { return flockmap::Robot(flockmap::default_options(), 0); }

const std::vector<float> kWall{2.05f, 0.0f, 0.0f, 2.05f, 0.1f, 0.0f};

// A robot that has seen a wall, and its map.
struct Seen {
    flockmap::Robot robot = ::robot();
    Seen() { robot.insert_scan(1'000, 1'000, kWall, flockmap::identity()); }
};

}  // namespace

TEST(points_of_a_wrong_length_are_refused) {
    Seen seen;
    const auto before = seen.robot.view().info();
    const std::vector<float> seven(7);
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "points has 7 numbers, expected 3",
                [&] { seen.robot.insert_scan(2'000, 2'000, seven, flockmap::identity()); }));
    const std::vector<double> four(4);
    std::vector<std::uint8_t> states(2);
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "points has 4", [&] { seen.robot.view().states(four, states); }));
    const std::vector<double> three(3);
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "states has 2 elements, expected 1", [&] { seen.robot.view().states(three, states); }));
    CHECK(seen.robot.view().info().version == before.version && seen.robot.counters().scans == 1);
}

TEST(lengths_that_no_memory_has_are_refused) {
    const Seen seen;
    const auto view = seen.robot.view();
    const double point[3] = {0, 0, 0};
    std::uint8_t state = 7;
    for (const std::size_t count : {SIZE_MAX, SIZE_MAX / 24, SIZE_MAX / 2}) {
        CHECK(flockmap_view_states(view.get(), point, count, &state) == FLOCKMAP_ERROR_ARGUMENT && state == 7);
        CHECK(std::strstr(flockmap_last_error(), "more than memory has") != nullptr);
        CHECK(flockmap_robot_insert_scan(seen.robot.get(), 0, 0, kWall.data(), count, nullptr, 0, flockmap::identity().data(),
                                         nullptr) == FLOCKMAP_ERROR_TOO_LARGE);
    }
    // Half of all there may be, in the right place: it is too much before it is looked at.
    CHECK(flockmap_robot_insert_scan(seen.robot.get(), 0, 0, kWall.data(), FLOCKMAP_SCAN_POINTS_MAX + 1, nullptr, 0,
                                     flockmap::identity().data(), nullptr) == FLOCKMAP_ERROR_TOO_LARGE);
}

TEST(poses_that_are_none_are_refused) {
    Seen seen;
    const auto refused = [&](std::size_t at, double value, const char* why) {
        auto pose = flockmap::at(1.0, 2.0, 3.0);
        pose[at] = value;
        return fails(FLOCKMAP_ERROR_ARGUMENT, why, [&] { seen.robot.insert_scan(2'000, 2'000, kWall, pose); }) &&
               fails(FLOCKMAP_ERROR_ARGUMENT, why, [&] { seen.robot.set_alignment(2, pose); }) &&
               fails(FLOCKMAP_ERROR_ARGUMENT, why, [&] { seen.robot.set_submap_pose(2'000, 0, pose); });
    };
    CHECK(refused(3, kNan, "not finite"));
    CHECK(refused(0, kInfinity, "not finite"));
    CHECK(refused(0, 2.0, "no rotation"));
    CHECK(refused(0, -1.0, "no rotation"));
    CHECK(refused(12, 1.0, "column by column"));
    CHECK(refused(15, 0.0, "last row"));
    CHECK(refused(3, 1e12, "grid"));
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "not finite", [&] { seen.robot.set_teammate(2, {kNan, 0, 0}, 0); }));
    CHECK(seen.robot.counters().scans == 1);
}

TEST(points_that_are_no_numbers_are_ignored_and_counted) {
    auto one = robot();
    const std::vector<float> points{NAN, 0, 0, 2, 0, 0, INFINITY, 0, 0};
    const auto report = one.insert_scan(0, 0, points, flockmap::identity());
    CHECK(report.ignored == 2 && report.hits == 1 && one.counters().points_ignored == 2);
}

TEST(files_that_are_none_are_refused_with_their_name) {
    const auto folder = std::filesystem::temp_directory_path() / ("flockmap-errors-" + std::to_string(std::random_device{}()));
    std::filesystem::create_directory(folder);
    const auto file = [&](const char* name, const std::string& content) {
        std::ofstream(folder / name, std::ios::binary) << content;
        return (folder / name).string();
    };
    const auto load = [](const std::string& path) { return [path] { flockmap::View::load(path); }; };
    CHECK(fails(FLOCKMAP_ERROR_FILE, "none.bt", load((folder / "none.bt").string())));
    CHECK(fails(FLOCKMAP_ERROR_FILE, "garbage.bt", load(file("garbage.bt", "# Octomap OcTree binary file\nsize 999999999\n"))));
    CHECK(fails(FLOCKMAP_ERROR_FILE, "garbage.ply", load(file("garbage.ply", std::string(1'000, '\x01')))));
    CHECK(fails(FLOCKMAP_ERROR_FILE, "empty.pcd", load(file("empty.pcd", ""))));
    CHECK(fails(FLOCKMAP_ERROR_FILE, "map.xyz", load(file("map.xyz", "1 2 3"))));
    const Seen seen;
    const auto view = seen.robot.view();
    CHECK(fails(FLOCKMAP_ERROR_FILE, "map.jpg", [&] { view.save((folder / "map.jpg").string()); }));
    CHECK(fails(FLOCKMAP_ERROR_FILE, "nowhere", [&] { view.save((folder / "nowhere" / "map.bt").string()); }));
    // And one that is.
    const auto map = (folder / "map.bt").string();
    CHECK(view.save(map) == view.info().free + view.info().occupied);
    const auto back = flockmap::View::load(map);
    CHECK(back.voxels(flockmap::State::Free) == view.voxels(flockmap::State::Free));
    CHECK(back.voxels(flockmap::State::Occupied) == view.voxels(flockmap::State::Occupied));
    std::filesystem::remove_all(folder);
}

TEST(options_that_cannot_work_are_named) {
    const auto with = [](const char* text, auto&& change) {
        auto options = flockmap::default_options();
        change(options);
        return fails(FLOCKMAP_ERROR_CONFIG, text, [&] { flockmap::Robot(options, 0); });
    };
    CHECK(with("resolution_m is 0", [](auto& options) { options.resolution_m = 0; }));
    CHECK(with("resolution_m is NaN", [](auto& options) { options.resolution_m = kNan; }));
    CHECK(with("range_m is inf", [](auto& options) { options.range_m = kInfinity; }));
    CHECK(with("range_min_m", [](auto& options) { options.range_min_m = kNan; }));
    CHECK(with("mapper is 17", [](auto& options) { options.mapper = 17; }));
    CHECK(with("publish_period_ms", [](auto& options) { options.publish_period_ms = 0; }));
    CHECK(with("one byte repeated", [](auto& options) { options.has_swarm_key = 1; }));
    const auto toml = [](const char* code, const std::string& text) {
        return fails(FLOCKMAP_ERROR_CONFIG, code, [&] { flockmap::Robot::from_toml(text, 0); });
    };
    CHECK(toml("line 3", "id = 1\n[map]\nresolution_mm = 0.1\nrange_m = 7.0\n"));
    CHECK(toml("range_m", "id = 1\n[map]\nresolution_m = 0.1\nrange_m = -7.0\n"));
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "UTF-8", [] { flockmap::Robot::from_toml("id = 1 # \xff", 0); }));
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "1 MiB", [] { flockmap::Robot::from_toml(std::string(2 << 20, ' '), 0); }));
    const auto good = flockmap::Robot::from_toml("id = 4\n[map]\nresolution_m = 0.25\nrange_m = 9.0\n", 0);
    CHECK(good.view().info().resolution_m == 0.25);
}

TEST(unknown_numbers_are_refused) {
    Seen seen;
    const auto view = seen.robot.view();
    const flockmap_box box{{0, 0, 0}, {4, 4, 4}}, none{{0, 0, 0}, {4, 0, 4}}, beyond{{1 << 28, 0, 0}, {2, 1, 1}};
    std::int8_t cells[16];
    std::uint8_t collides = 0;
    std::size_t count = 0;
    flockmap_field* field = nullptr;
    const double origin[3] = {0, 0, 0};
    CHECK(flockmap_view_occupancy_grid(view.get(), &box, 9, cells, 16) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_occupancy_grid(view.get(), &none, 0, cells, 16) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_occupancy_grid(view.get(), &beyond, 0, cells, 16) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_occupancy_grid(view.get(), &box, 0, cells, 15) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_spheres(view.get(), -1, origin, 1, 0.1, &collides) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_spheres(view.get(), 0, origin, 1, -0.1, &collides) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_spheres(view.get(), 0, origin, 1, kNan, &collides) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_view_spheres(view.get(), 0, origin, 1, 1e9, &collides) < 0);
    CHECK(flockmap_view_voxels(view.get(), nullptr, 0, nullptr, 0, &count) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(flockmap_field_new(view.get(), &box, 5, 0, &field) == FLOCKMAP_ERROR_ARGUMENT && field == nullptr);
    CHECK(flockmap_field_new(view.get(), &box, 0, 16, &field) == FLOCKMAP_ERROR_TOO_LARGE && field == nullptr);
    CHECK(flockmap_robot_set_muted(seen.robot.get(), 2, 3) == FLOCKMAP_ERROR_ARGUMENT);
    const std::int32_t voxel[3] = {1, 2, 3};
    const std::uint8_t state = 3;
    CHECK(flockmap_robot_insert_states(seen.robot.get(), 0, 0, 0.1, nullptr, voxel, &state, 1, nullptr) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(std::strstr(flockmap_last_error(), "states[0] is 3") != nullptr);
    const std::uint8_t free = 1;
    CHECK(flockmap_robot_insert_states(seen.robot.get(), 0, 0, 0.2, nullptr, voxel, &free, 1, nullptr) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(std::strstr(flockmap_last_error(), "0.2") != nullptr);
    const std::uint32_t huge[3] = {UINT32_MAX, UINT32_MAX, UINT32_MAX};
    CHECK(flockmap_robot_insert_box(seen.robot.get(), 0, 0, 0.1, nullptr, voxel, huge, &free, 1, 0, nullptr) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(std::strcmp(flockmap_result_name(42), "FLOCKMAP_UNKNOWN") == 0);
}

TEST(buffers_that_are_too_small_or_overlap_are_refused) {
    const Seen seen;
    const auto view = seen.robot.view();
    std::size_t count = 0;
    std::int32_t voxels[3] = {7, 7, 7};
    CHECK(flockmap_view_voxels(view.get(), nullptr, 1, voxels, 1, &count) == FLOCKMAP_ERROR_BUFFER);
    CHECK(count == view.info().free && voxels[0] == 7);
    std::uint8_t bytes[FLOCKMAP_DATAGRAM_BYTES_MAX];
    flockmap_transmit transmit;
    CHECK(flockmap_robot_handle_timeout(seen.robot.get(), 2'000'000) == FLOCKMAP_OK);
    CHECK(flockmap_robot_poll_transmit(seen.robot.get(), 2'000'000, bytes, sizeof bytes - 1, &transmit) == FLOCKMAP_ERROR_BUFFER);
    CHECK(flockmap_robot_poll_transmit(seen.robot.get(), 2'000'000, bytes, sizeof bytes, &transmit) == FLOCKMAP_OK);
    // In and out in one array.
    double both[6] = {};
    CHECK(flockmap_view_states(view.get(), both, 2, reinterpret_cast<std::uint8_t*>(both)) == FLOCKMAP_ERROR_ARGUMENT);
    CHECK(std::strstr(flockmap_last_error(), "overlaps") != nullptr);
    // A place where no double lies.
    CHECK(flockmap_view_states(view.get(), reinterpret_cast<double*>(reinterpret_cast<char*>(both) + 1), 1, bytes) ==
          FLOCKMAP_ERROR_ARGUMENT);
}

TEST(any_bytes_are_taken_as_a_datagram_and_change_nothing) {
    Seen seen;
    std::mt19937 random(2);
    int refused = 0;
    for (int round = 0; round < 2'000; ++round) {
        std::vector<std::uint8_t> bytes(random() % 1'500);
        for (auto& byte : bytes) {
            byte = static_cast<std::uint8_t>(random());
        }
        refused += !seen.robot.handle_datagram_from(1'000, random() % 4, bytes);
    }
    CHECK(refused == 2'000 && seen.robot.view().info().occupied > 0);
    CHECK(!seen.robot.handle_datagram(1'000, std::vector<std::uint8_t>(1 << 20)));
}

TEST(numbers_that_are_none_have_an_answer) {
    const Seen seen;
    const auto view = seen.robot.view();
    CHECK(view.state_at({kNan, 0, 0}) == flockmap::State::Unknown);
    CHECK(view.state_at({1e300, -kInfinity, 0}) == flockmap::State::Unknown);
    const std::vector<double> from{0, 0, 0, kNan, 0, 0}, to{1, 0, 0, 1, 0, 0};
    const auto hits = view.cast_rays(from, to, true);
    CHECK(hits[0].state == FLOCKMAP_VOXEL_STATE_FREE && hits[1].state == FLOCKMAP_VOXEL_STATE_UNKNOWN);
    const std::vector<double> far{2e6, 0, 0}, start{0, 0, 0};
    CHECK(fails(FLOCKMAP_ERROR_TOO_LARGE, "voxels", [&] { view.cast_rays(start, far, true); }));
    flockmap::Field field(view, *view.bounds(), flockmap::Obstacles::Occupied);
    CHECK(std::isnan(field.at({kNan, 0, 0}).distance_m) && std::isnan(field.at({1e300, 0, 0}).distance_m));
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "no box", [] { flockmap::box_between(0.1, {0, 0, 0}, {1, kNan, 1}); }));
    CHECK(fails(FLOCKMAP_ERROR_ARGUMENT, "reach_m", [&] { flockmap::frontiers(view, *view.bounds(), kNan); }));
}

TEST(null_is_an_error_everywhere) {
    const Seen seen;
    const auto view = seen.robot.view();
    const auto field = flockmap::Field(view, *view.bounds(), flockmap::Obstacles::Occupied);
    flockmap_robot* const r = seen.robot.get();
    const flockmap_view* const v = view.get();
    const flockmap_box box = *view.bounds();
    flockmap_robot_options options = flockmap::default_options();
    double d[16] = {};
    float f[16] = {};
    std::int32_t i[16] = {};
    std::uint32_t u[16] = {};
    std::uint64_t w[16] = {};
    std::uint8_t b[1200] = {};
    std::int8_t c[16] = {};
    std::size_t n = 0;
    std::int64_t due = 0;
    flockmap_transmit transmit;
    flockmap_counters counters;
    flockmap_event event;
    flockmap_robot* new_robot = nullptr;
    flockmap_view* new_view = nullptr;
    flockmap_field* new_field = nullptr;
    flockmap_frontiers* new_frontiers = nullptr;
    flockmap_frontier frontier;
    flockmap_view_summary info;
    flockmap_ray_hit hit;
    flockmap_box out;
    flockmap_layer layer;
    const std::vector<flockmap_result> results{
        flockmap_robot_options_default(nullptr), flockmap_robot_new(nullptr, 0, &new_robot),
        flockmap_robot_new(&options, 0, nullptr), flockmap_robot_new_from_toml(nullptr, 0, 0, &new_robot),
        flockmap_robot_new_from_toml("", 0, 0, nullptr),
        flockmap_robot_insert_scan(nullptr, 0, 0, f, 1, nullptr, 0, d, nullptr),
        flockmap_robot_insert_scan(r, 0, 0, nullptr, 1, nullptr, 0, d, nullptr),
        flockmap_robot_insert_scan(r, 0, 0, f, 1, nullptr, 1, d, nullptr),
        flockmap_robot_insert_scan(r, 0, 0, f, 1, nullptr, 0, nullptr, nullptr),
        flockmap_robot_insert_states(nullptr, 0, 0, 0.1, nullptr, i, b, 1, nullptr),
        flockmap_robot_insert_states(r, 0, 0, 0.1, nullptr, nullptr, b, 1, nullptr),
        flockmap_robot_insert_states(r, 0, 0, 0.1, nullptr, i, nullptr, 1, nullptr),
        flockmap_robot_insert_box(nullptr, 0, 0, 0.1, nullptr, i, u, b, 1, 0, nullptr),
        flockmap_robot_insert_box(r, 0, 0, 0.1, nullptr, nullptr, u, b, 1, 0, nullptr),
        flockmap_robot_insert_box(r, 0, 0, 0.1, nullptr, i, nullptr, b, 1, 0, nullptr),
        flockmap_robot_insert_box(r, 0, 0, 0.1, nullptr, i, u, nullptr, 1, 0, nullptr),
        flockmap_robot_set_alignment(nullptr, 1, d), flockmap_robot_set_alignment(r, 1, nullptr),
        flockmap_robot_begin_submap(nullptr, 0, nullptr), flockmap_robot_set_submap_pose(nullptr, 0, 0, d),
        flockmap_robot_set_submap_pose(r, 0, 0, nullptr),
        flockmap_robot_set_clock_offset(nullptr, 1, 0, 0), flockmap_robot_set_muted(nullptr, 1, 0),
        flockmap_robot_set_teammate(nullptr, 1, d, 0), flockmap_robot_set_teammate(r, 1, nullptr, 0),
        flockmap_robot_handle_datagram(nullptr, 0, b, 1), flockmap_robot_handle_datagram(r, 0, nullptr, 1),
        flockmap_robot_handle_datagram_from(nullptr, 0, 0, b, 1), flockmap_robot_handle_datagram_from(r, 0, 0, nullptr, 1),
        flockmap_robot_handle_timeout(nullptr, 0), flockmap_robot_poll_timeout(nullptr, &due),
        flockmap_robot_poll_timeout(r, nullptr), flockmap_robot_poll_transmit(nullptr, 0, b, sizeof b, &transmit),
        flockmap_robot_poll_transmit(r, 0, nullptr, sizeof b, &transmit), flockmap_robot_poll_transmit(r, 0, b, sizeof b, nullptr),
        flockmap_robot_poll_event(nullptr, &event), flockmap_robot_poll_event(r, nullptr), flockmap_robot_flush(nullptr, 0),
        flockmap_robot_unpublished(nullptr, &n), flockmap_robot_unpublished(r, nullptr),
        flockmap_robot_counters(nullptr, &counters), flockmap_robot_counters(r, nullptr),
        flockmap_robot_layers(nullptr, &layer, 1, &n), flockmap_robot_layers(r, nullptr, 1, &n),
        flockmap_robot_layers(r, &layer, 1, nullptr), flockmap_robot_view(nullptr, &new_view), flockmap_robot_view(r, nullptr),
        flockmap_view_new(0.1, nullptr), flockmap_view_with_blocks(nullptr, i, w, w, 1, &new_view),
        flockmap_view_with_blocks(v, nullptr, w, w, 1, &new_view), flockmap_view_with_blocks(v, i, nullptr, w, 1, &new_view),
        flockmap_view_with_blocks(v, i, w, nullptr, 1, &new_view), flockmap_view_with_blocks(v, i, w, w, 1, nullptr),
        flockmap_view_info(nullptr, &info), flockmap_view_info(v, nullptr), flockmap_view_bounds(nullptr, &out),
        flockmap_view_bounds(v, nullptr), flockmap_box_between(0.1, nullptr, d, &out), flockmap_box_between(0.1, d, nullptr, &out),
        flockmap_box_between(0.1, d, d, nullptr), flockmap_view_states(nullptr, d, 1, b), flockmap_view_states(v, nullptr, 1, b),
        flockmap_view_states(v, d, 1, nullptr), flockmap_view_voxel_states(nullptr, i, 1, b),
        flockmap_view_voxel_states(v, nullptr, 1, b), flockmap_view_voxel_states(v, i, 1, nullptr),
        flockmap_view_block(nullptr, i, w, w + 8), flockmap_view_block(v, nullptr, w, w + 8),
        flockmap_view_block(v, i, nullptr, w), flockmap_view_block(v, i, w, nullptr),
        flockmap_view_changed_since(nullptr, 0, i, 1, &n), flockmap_view_changed_since(v, 0, nullptr, 1, &n),
        flockmap_view_changed_since(v, 0, i, 1, nullptr), flockmap_view_voxels(nullptr, nullptr, 1, i, 1, &n),
        flockmap_view_voxels(v, nullptr, 1, nullptr, 1, &n), flockmap_view_voxels(v, nullptr, 1, i, 1, nullptr),
        flockmap_view_occupied_points(nullptr, nullptr, f, 1, &n), flockmap_view_occupied_points(v, nullptr, nullptr, 1, &n),
        flockmap_view_occupied_points(v, nullptr, f, 1, nullptr), flockmap_view_cast_rays(nullptr, d, d, 1, 0, &hit),
        flockmap_view_cast_rays(v, nullptr, d, 1, 0, &hit), flockmap_view_cast_rays(v, d, nullptr, 1, 0, &hit),
        flockmap_view_cast_rays(v, d, d, 1, 0, nullptr), flockmap_view_spheres(nullptr, 0, d, 1, 0.1, b),
        flockmap_view_spheres(v, 0, nullptr, 1, 0.1, b), flockmap_view_spheres(v, 0, d, 1, 0.1, nullptr),
        flockmap_view_segments(nullptr, 0, d, d, 1, 0.1, d + 8, nullptr), flockmap_view_segments(v, 0, nullptr, d, 1, 0.1, d + 8, nullptr),
        flockmap_view_segments(v, 0, d, nullptr, 1, 0.1, d + 8, nullptr), flockmap_view_segments(v, 0, d, d, 1, 0.1, nullptr, nullptr),
        flockmap_view_occupancy_grid(nullptr, &box, 0, c, 16), flockmap_view_occupancy_grid(v, nullptr, 0, c, 16),
        flockmap_view_occupancy_grid(v, &box, 0, nullptr, 16), flockmap_view_height_map(nullptr, &box, f, nullptr, 16),
        flockmap_view_height_map(v, nullptr, f, nullptr, 16), flockmap_view_save(nullptr, "map.bt", 0, nullptr),
        flockmap_view_save(v, nullptr, 0, nullptr), flockmap_view_load(nullptr, 0.1, &new_view), flockmap_view_load("map.bt", 0.1, nullptr),
        flockmap_field_new(nullptr, &box, 0, 0, &new_field), flockmap_field_new(v, nullptr, 0, 0, &new_field),
        flockmap_field_new(v, &box, 0, 0, nullptr), flockmap_field_update(nullptr, v, i), flockmap_field_move_to(nullptr, v, &box),
        flockmap_field_box(nullptr, &out), flockmap_field_at(nullptr, d, 1, d + 8, nullptr), flockmap_field_are_clear(nullptr, d, 1, 0.1, b),
        flockmap_field_array(nullptr, f, 16), flockmap_frontiers_new(nullptr, &box, 1, 1, &new_frontiers),
        flockmap_frontiers_new(v, nullptr, 1, 1, &new_frontiers), flockmap_frontiers_new(v, &box, 1, 1, nullptr),
        flockmap_frontiers_count(nullptr, &n), flockmap_frontiers_get(nullptr, 0, &frontier),
        flockmap_frontiers_voxels(nullptr, 0, i, 1, &n),
    };
    for (std::size_t at = 0; at < results.size(); ++at) {
        if (results[at] != FLOCKMAP_ERROR_NULL) {
            throw std::logic_error("call " + std::to_string(at) + " is " + flockmap_result_name(results[at]));
        }
    }
    CHECK(std::strstr(flockmap_last_error(), "found is null") != nullptr);
    CHECK(new_robot == nullptr && new_view == nullptr && new_field == nullptr && new_frontiers == nullptr);
    // Nothing to free is well.
    flockmap_robot_free(nullptr);
    flockmap_view_free(nullptr);
    flockmap_field_free(nullptr);
    flockmap_frontiers_free(nullptr);
    (void)field;
}
