// What the library answers, from C++; and from several threads.
#include <atomic>
#include <cmath>
#include <thread>

#include "check.hpp"
#include "flockmap.hpp"

using flockmap::State;

namespace {

// A wall at x = 2.05 m from y = -1 to 1 and z = 0 to 1, seen from (0, 0, 0.5).
std::vector<float> wall() {
    std::vector<float> points;
    for (int y = -10; y < 10; ++y) {
        for (int z = -5; z < 5; ++z) {
            points.insert(points.end(), {2.05f, y * 0.1f + 0.05f, z * 0.1f + 0.05f});
        }
    }
    return points;
}

flockmap::Robot robot_before_a_wall(std::uint16_t id = 1) {
    auto options = flockmap::default_options();
    options.id = id;
    flockmap::Robot robot(options, 0);
    const auto report = robot.insert_scan(1'000, 1'000, wall(), flockmap::at(0, 0, 0.5));
    CHECK(report.hits == 200 && report.changed > 200);
    return robot;
}

}  // namespace

TEST(a_view_outlives_its_robot_and_does_not_change) {
    std::optional<flockmap::View> view;
    {
        auto robot = robot_before_a_wall();
        view = robot.view();
        robot.insert_scan(2'000, 2'000, std::vector<float>{0.0f, 3.05f, 0.0f}, flockmap::at(0, 0, 0.5));
        CHECK(robot.view().info().version > view->info().version);
        const auto changed = robot.view().changed_since(view->info().version);
        CHECK(changed && !changed->empty() && changed->size() % 3 == 0);
    }
    CHECK(view->info().occupied == 200 && view->state_at({2.05, 0.05, 0.55}) == State::Occupied);
}

TEST(all_ways_to_ask_agree) {
    const auto view = robot_before_a_wall().view();
    const auto occupied = view.voxels(State::Occupied), free = view.voxels(State::Free);
    const auto points = view.occupied_points();
    CHECK(occupied.size() == view.info().occupied && free.size() == view.info().free && points.size() == occupied.size());
    std::vector<std::int32_t> numbers;
    std::vector<double> centres;
    for (std::size_t i = 0; i < occupied.size(); ++i) {
        numbers.insert(numbers.end(), occupied[i].begin(), occupied[i].end());
        for (std::size_t axis = 0; axis < 3; ++axis) {
            CHECK(std::abs(static_cast<double>(points[i][axis]) - (occupied[i][axis] + 0.5) * 0.1) < 1e-5);
            centres.push_back((occupied[i][axis] + 0.5) * 0.1);
        }
    }
    std::vector<std::uint8_t> by_voxel(occupied.size()), by_point(occupied.size());
    view.voxel_states(numbers, by_voxel);
    view.states(centres, by_point);
    CHECK(by_voxel == std::vector<std::uint8_t>(occupied.size(), FLOCKMAP_VOXEL_STATE_OCCUPIED) && by_point == by_voxel);
    std::size_t in_blocks = 0;
    const auto all = view.changed_since(0).value();
    for (std::size_t i = 0; i < all.size(); i += 3) {
        const auto block = view.block({all[i], all[i + 1], all[i + 2]});
        CHECK(block);
        for (std::uint64_t word : block->occupied) {
            for (; word != 0; word &= word - 1) {
                ++in_blocks;
            }
        }
    }
    CHECK(in_blocks == occupied.size() && !view.block({1'000, 0, 0}));
    const flockmap::Box half{{0, 0, -100}, {100, 100, 200}};
    CHECK(view.voxels(State::Occupied, &half).size() == 100);
}

TEST(products_see_the_wall) {
    const auto view = robot_before_a_wall().view();
    const auto box = flockmap::box_between(0.1, {0, -1, 0}, {3, 1, 1});
    flockmap::Field field(view, box, flockmap::Obstacles::Occupied);
    const auto near = field.at({1.05, 0.05, 0.55});
    CHECK(std::abs(near.distance_m - 1.0) < 1e-9 && near.gradient[0] < -0.99);
    CHECK(field.update(view) == flockmap::Updated::Unchanged);
    const auto array = field.array();
    CHECK(array.size() == 30 * 20 * 10 && std::abs(array[(5 * 20 + 10) * 30 + 10] - 1.0f) < 1e-6f);
    const std::vector<double> centres{1.5, 0.05, 0.55, 0.5, 0.05, 0.55};
    CHECK((view.spheres(flockmap::Obstacles::Occupied, centres, 0.6) == std::vector<std::uint8_t>{1, 0}));
    CHECK((field.are_clear(centres, 0.6) == std::vector<std::uint8_t>{0, 1}));
    const std::vector<double> from{0.5, 0.05, 0.55}, to{3.0, 0.05, 0.55}, away{0.0, 0.05, 0.55};
    CHECK(std::abs(view.segments(flockmap::Obstacles::Occupied, from, to, 0.25)[0] - (2.0 - 0.25 - 0.5)) < 1e-9);
    CHECK(std::isinf(view.segments(flockmap::Obstacles::Occupied, from, away, 0.25)[0]));
    const auto hits = view.cast_rays(from, to, true);
    CHECK(hits[0].state == FLOCKMAP_VOXEL_STATE_OCCUPIED && hits[0].voxel[0] == 20 && std::abs(hits[0].distance_m - 1.5) < 1e-9);
    const auto grid = view.occupancy_grid(box, flockmap::ColumnRule::AnyFree);
    CHECK(grid.size() == 600 && grid[10 * 30 + 20] == 100 && grid[10 * 30 + 10] == 0 && grid[10 * 30 + 29] == -1);
    const auto heights = view.height_map(box);
    CHECK(std::abs(heights.tops_m[10 * 30 + 20] - 1.0f) < 1e-6f && std::isnan(heights.tops_m[10 * 30 + 10]));
    const auto found = flockmap::frontiers(view, box);
    CHECK(!found.empty() && !found[0].voxels.empty());
    for (const auto& frontier : found) {
        for (const auto& voxel : frontier.voxels) {
            CHECK(view.state_at({(voxel[0] + 0.5) * 0.1, (voxel[1] + 0.5) * 0.1, (voxel[2] + 0.5) * 0.1}) == State::Free);
        }
    }
}

TEST(blocks_of_a_mirror_make_a_view) {
    const flockmap::View empty(0.1);
    std::vector<std::uint64_t> free(8, ~std::uint64_t{1}), occupied(8, 1);
    const std::vector<std::int32_t> indices{-1, 0, 2};
    const auto view = empty.with_blocks(indices, free, occupied);
    CHECK(empty.info().blocks == 0 && view.info().occupied == 8 && view.info().free == 8 * 63);
    CHECK(view.state_at({-0.75, 0.05, 1.65}) == State::Occupied && view.state_at({-0.65, 0.05, 1.65}) == State::Free);
    free[3] |= 1;
    try {
        (void)empty.with_blocks(indices, free, occupied);
        CHECK(false);
    } catch (const flockmap::Error& error) {
        CHECK(error.code() == FLOCKMAP_ERROR_ARGUMENT);
    }
}

TEST(states_of_another_mapper_come_out_as_they_went_in) {
    flockmap::Robot robot(flockmap::default_options(), 0);
    const std::vector<std::int32_t> voxels{20, 0, 0, 19, 0, 0};
    const std::vector<std::uint8_t> states{FLOCKMAP_VOXEL_STATE_OCCUPIED, FLOCKMAP_VOXEL_STATE_FREE};
    const flockmap::Point sensor{0.05, 0.05, 0.05};
    CHECK(robot.insert_states(1'000, 1'000, 0.1, voxels, states, &sensor).changed == 2);
    const std::vector<std::uint8_t> row{0, 1, 2};
    CHECK(robot.insert_box(2'000, 2'000, 0.1, {{18, 0, 0}, {3, 1, 1}}, row, false).changed == 0);
    const std::vector<std::uint8_t> cleared{1, 1, 1};
    CHECK(robot.insert_box(3'000, 3'000, 0.1, {{18, 0, 0}, {3, 1, 1}}, cleared, false).changed == 2);
    CHECK(robot.view().info().occupied == 0 && robot.view().info().free == 3 && robot.counters().states == 3);
}

TEST(two_robots_in_memory_agree_and_events_say_so) {
    auto alice = robot_before_a_wall(1);
    flockmap::Robot bob([] {
        auto options = flockmap::default_options();
        options.id = 2;
        return options;
    }(), 0);
    for (std::int64_t now = 1'000; now < 4'000'000; now += 10'000) {
        for (auto* robot : {&alice, &bob}) {
            robot->handle_timeout(now);
        }
        while (const auto datagram = alice.poll_transmit(now)) {
            CHECK(bob.handle_datagram(now, datagram->bytes));
        }
        while (const auto datagram = bob.poll_transmit(now)) {
            CHECK(alice.handle_datagram(now, datagram->bytes));
        }
    }
    CHECK(bob.view().voxels(State::Occupied) == alice.view().voxels(State::Occupied) && bob.view().info().occupied == 200);
    bool has_seen = false, has_merged = false;
    while (const auto event = bob.poll_event()) {
        has_seen |= event->kind == FLOCKMAP_EVENT_KIND_PEER_SEEN && event->origin == 1;
        has_merged |= event->kind == FLOCKMAP_EVENT_KIND_MERGED && event->origin == 1 && event->count > 0;
    }
    CHECK(has_seen && has_merged && bob.counters().merged > 0 && alice.counters().bytes_out > 0);
    // What is set comes into force a part with each call, which is due until it has.
    const auto finish = [&bob] {
        while (bob.poll_timeout().value_or(5'000'000) <= 4'000'000) {
            bob.handle_timeout(4'000'000);
            while (bob.poll_transmit(4'000'000)) {}
        }
    };
    bob.set_muted(1, true);
    finish();
    CHECK(bob.view().info().occupied == 0);
    bob.set_muted(1, false);
    bob.set_alignment(1, flockmap::at(0, 0, 10));
    finish();
    CHECK(bob.view().state_at({2.05, 0.05, 10.55}) == State::Occupied && bob.view().state_at({2.05, 0.05, 0.55}) == State::Unknown);
}

TEST(a_submap_moves_with_what_was_seen_in_it) {
    auto robot = robot_before_a_wall();
    const std::int64_t now = 1'000'000;
    CHECK(robot.begin_submap(now) == 1);
    robot.set_submap_pose(now, 0, flockmap::at(0, 0, 10));
    while (robot.poll_timeout().value_or(9'000'000) <= 4'000'000) {
        robot.handle_timeout(4'000'000);
        while (robot.poll_transmit(4'000'000)) {}
    }
    CHECK(robot.view().state_at({2.05, 0.05, 10.55}) == State::Occupied && robot.view().state_at({2.05, 0.05, 0.55}) == State::Unknown);
    bool is_refused = false;
    try {
        robot.set_submap_pose(now, 2, flockmap::at(0, 0, 0));
    } catch (const flockmap::Error& error) {
        is_refused = std::string(error.what()).find("submap 2 has not begun") != std::string::npos;
    }
    CHECK(is_refused);
}

TEST(a_robot_is_used_from_many_threads) {
    auto robot = robot_before_a_wall();
    constexpr int kRounds = 200;
    std::atomic<int> wrong{0};
    const auto points = wall();
    const auto work = [&](int thread) {
        try {
            for (int round = 0; round < kRounds; ++round) {
                const std::int64_t now = 10'000 * round;
                switch (thread) {
                    case 0: robot.insert_scan(now, now, points, flockmap::at(0, 0, 0.5)); break;
                    case 1: robot.handle_timeout(now); while (robot.poll_transmit(now)) {} break;
                    case 2: wrong += robot.view().info().occupied < 200; break;
                    default: {
                        // A wrong call of one thread is no error of another one.
                        wrong += flockmap_robot_set_muted(robot.get(), 1, 9) != FLOCKMAP_ERROR_ARGUMENT;
                        wrong += std::string(flockmap_last_error()).find("is_muted is 9") == std::string::npos;
                    }
                }
            }
        } catch (const std::exception&) {
            ++wrong;
        }
    };
    std::vector<std::thread> threads;
    for (int thread = 0; thread < 4; ++thread) {
        threads.emplace_back(work, thread);
    }
    for (auto& thread : threads) {
        thread.join();
    }
    CHECK(wrong == 0 && robot.counters().scans == kRounds + 1);
}

TEST(a_view_and_a_field_are_asked_by_many_threads) {
    auto robot = robot_before_a_wall();
    const auto view = robot.view();
    flockmap::Field field(view, *view.bounds(), flockmap::Obstacles::Occupied);
    robot.insert_scan(2'000, 2'000, std::vector<float>{1.05f, 0.05f, 0.05f}, flockmap::at(0, 0, 0.5));
    const auto newer = robot.view();
    std::atomic<int> wrong{0};
    std::vector<std::thread> threads;
    for (int thread = 0; thread < 4; ++thread) {
        threads.emplace_back([&, thread] {
            for (int round = 0; round < 100; ++round) {
                if (thread == 0) {
                    field.update(round % 2 == 0 ? newer : view);
                } else {
                    wrong += !(field.at({1.5, 0.05, 0.55}).distance_m > 0) || view.state_at({2.05, 0.05, 0.55}) != State::Occupied;
                }
            }
        });
    }
    for (auto& thread : threads) {
        thread.join();
    }
    CHECK(wrong == 0);
}
