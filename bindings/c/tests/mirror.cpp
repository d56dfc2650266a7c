// The mirror against the bytes of docs/map-output.md, and against bytes that are none.
#include "flockmap_mirror.hpp"

#include <fstream>
#include <random>
#include <sstream>

#include "check.hpp"

using namespace flockmap_mirror;

namespace {

using Bytes = std::vector<std::uint8_t>;

// The bytes of the page's example: what the reader sends, and what the node does.
std::pair<Bytes, Bytes> example() {
    std::ifstream page(MAP_OUTPUT_PAGE);
    std::string line;
    Bytes reader, node;
    bool is_within = false, is_reader = false;
    while (std::getline(page, line)) {
        if (line == "```hex") {
            is_within = true;
        } else if (is_within && line == "```") {
            break;
        } else if (is_within && line[0] == '#') {
            is_reader = line.rfind("# the reader", 0) == 0;
        } else if (is_within) {
            std::istringstream numbers(line);
            for (unsigned byte; numbers >> std::hex >> byte;) {
                (is_reader ? reader : node).push_back(static_cast<std::uint8_t>(byte));
            }
        }
    }
    return {reader, node};
}

void put(Bytes& bytes, std::uint64_t value, int count) {
    for (int i = 0; i < count; ++i) {
        bytes.push_back(static_cast<std::uint8_t>(value >> (8 * i)));
    }
}

Bytes frame(std::uint8_t kind, const Bytes& body) {
    Bytes bytes;
    put(bytes, body.size() + 1, 4);
    bytes.push_back(kind);
    bytes.insert(bytes.end(), body.begin(), body.end());
    return bytes;
}

Bytes hello(std::uint64_t feed, std::uint8_t flags = 0, std::uint32_t micrometres = 200'000) {
    Bytes body{'F', 'L', 'K', 'M', 1, flags, 7, 0};
    put(body, micrometres, 4);
    put(body, feed, 8);
    body.insert(body.end(), {1, 'a', 3, 'm', 'a', 'p'});
    return frame(1, body);
}

Bytes anew(std::uint64_t version) {
    Bytes body;
    put(body, version, 8);
    return frame(3, body);
}

// A submaps frame of runs of these robots, each with these submaps, one metre apart.
Bytes submaps(const std::vector<std::uint16_t>& robots, const std::vector<std::uint16_t>& numbers, double scale = 1.0) {
    const auto put_f64 = [](Bytes& body, double value) {
        std::uint64_t bits;
        std::memcpy(&bits, &value, sizeof bits);
        put(body, bits, 8);
    };
    Bytes body;
    put(body, robots.size(), 2);
    for (const auto robot : robots) {
        put(body, robot, 2);
        put(body, 5, 8);
        put(body, 9, 2);
        put(body, 0, 2);
        put(body, numbers.size(), 2);
        for (const auto number : numbers) {
            put(body, number, 2);
            for (const double value : {double(number), 0.0, 0.0, 0.0, 0.0, 0.0, scale}) {
                put_f64(body, value);
            }
        }
    }
    return frame(10, body);
}

// A blocks frame with a block of one occupied voxel at each x.
Bytes blocks(std::uint64_t upto, std::uint64_t newest, const std::vector<std::int32_t>& xs, bool is_emptied = false) {
    Bytes body;
    put(body, upto, 8);
    put(body, newest, 8);
    put(body, 1'000, 8);
    body.push_back(0);
    put(body, xs.size(), 4);
    for (const std::int32_t x : xs) {
        put(body, static_cast<std::uint32_t>(x), 4);
        put(body, 0, 8);
        for (int word = 0; word < 16; ++word) {
            put(body, word == 8 && !is_emptied ? 1 : 0, 8);
        }
    }
    return frame(2, body);
}

void give(Mirror& mirror, const Bytes& bytes) { mirror.receive(bytes.data(), bytes.size()); }

bool refuses(Mirror& mirror, const Bytes& bytes) {
    try {
        give(mirror, bytes);
        return false;
    } catch (const FeedError&) {
        return true;
    }
}

}  // namespace

TEST(the_example_of_the_page_is_read_however_it_is_cut) {
    const auto [reader, node] = example();
    CHECK(reader.size() == 35 && node.size() == 35 + 13 + 174 + 82 + 35 + 58 + 89 + 34 + 139 + 18);
    for (std::size_t step = 1; step <= node.size(); step += step < 64 ? 1 : 61) {
        Mirror mirror;
        CHECK(mirror.begin() == reader);
        for (std::size_t at = 0; at < node.size(); at += step) {
            mirror.receive(node.data() + at, std::min(step, node.size() - at));
        }
        CHECK(mirror.node()->robot == 7 && mirror.node()->name == "alpha" && mirror.node()->frame == "map");
        CHECK(mirror.map().micrometres() == 200'000 && mirror.is_caught_up() && mirror.version() == 5);
        CHECK(mirror.stamp_us() == 1'700'000'000'000'000);
        CHECK(mirror.map().state({8, 0, -8}) == State::Occupied && mirror.map().state({15, 7, -1}) == State::Occupied);
        CHECK(mirror.map().state({9, 0, -8}) == State::Free && mirror.map().state({10, 0, -8}) == State::Free);
        CHECK(mirror.map().state({11, 0, -8}) == State::Unknown && mirror.map().state_at(1.7, 0.1, -1.5) == State::Occupied);
        std::size_t known = 0;
        mirror.map().for_each([&](const Index& voxel, State state) {
            CHECK(mirror.map().state(voxel) == state);
            ++known;
        });
        CHECK(known == 4);
        CHECK(mirror.robots().size() == 1 && mirror.robots()[0].epoch == 3 && mirror.robots()[0].age_us == 1'500'000);
        CHECK((mirror.robots()[0].position_m == std::array<double, 3>{1.0, -2.0, 0.5}) && mirror.robots()[0].is_turned);
        CHECK(mirror.counters().size() == 1 && mirror.counters()[0].first == "node_frames" && mirror.counters()[0].second == 300);
        CHECK(mirror.submaps().size() == 1 && mirror.submaps()[0].epoch == 3 && mirror.submaps()[0].newest == 4);
        const auto& run = mirror.submaps()[0];
        CHECK(run.pose(0)->position_m[1] == 0.0 && run.pose(1) == run.pose(0) && run.pose(2)->position_m[1] == 0.5);
        CHECK(run.pose(4)->position_m[2] == -0.25 && run.pose(4)->quaternion_xyzw[3] == 1.0 && run.pose(5) == nullptr);
        CHECK(mirror.end() == "the node ends");
    }
}

TEST(submaps_are_asked_for_only_if_they_are_wanted) {
    Options options;
    CHECK(Mirror(options).begin()[10] == 0);
    options.wants_submaps = true;
    CHECK(Mirror(options).begin()[10] == 16);
    options.wants_origins = true;
    CHECK(Mirror(options).begin()[10] == 17);
}

TEST(a_reader_that_comes_back_says_what_it_has_and_goes_on) {
    Mirror mirror;
    (void)mirror.begin();
    give(mirror, hello(9));
    give(mirror, anew(10));
    give(mirror, blocks(4, 10, {0, 1}));
    CHECK(!mirror.is_caught_up());
    Bytes expected = frame(1, {'F', 'L', 'K', 'M', 1, 0});
    expected[0] = 31;
    put(expected, 9, 8);
    put(expected, 10, 8);
    put(expected, 4, 8);
    CHECK(mirror.begin() == expected);
    give(mirror, hello(9, 2));
    give(mirror, blocks(11, 11, {1, 2}));
    CHECK(mirror.is_caught_up() && mirror.map().blocks().size() == 3);
}

TEST(a_map_that_begins_anew_is_shown_once_it_is_whole) {
    Mirror mirror;
    (void)mirror.begin();
    give(mirror, hello(9));
    give(mirror, anew(2));
    give(mirror, blocks(2, 2, {0, 1}));
    // The node has started again, with another resolution.
    (void)mirror.begin();
    give(mirror, hello(10, 0, 100'000));
    CHECK(mirror.map().blocks().size() == 2);
    give(mirror, anew(8));
    give(mirror, blocks(5, 9, {5}));
    CHECK(mirror.map().micrometres() == 200'000 && mirror.map().block({0, 0, 0}) != nullptr && !mirror.is_caught_up());
    give(mirror, blocks(8, 9, {6, 7}));
    CHECK(mirror.map().micrometres() == 100'000 && mirror.map().blocks().size() == 3 && !mirror.is_caught_up());
    give(mirror, blocks(9, 9, {}));
    CHECK(mirror.is_caught_up());
}

TEST(a_block_that_was_emptied_is_forgotten) {
    Mirror mirror;
    (void)mirror.begin();
    give(mirror, hello(9));
    give(mirror, anew(1));
    give(mirror, blocks(1, 1, {0, 1}));
    give(mirror, blocks(2, 2, {0}, true));
    CHECK(mirror.map().blocks().size() == 1 && mirror.map().block({1, 0, 0}) != nullptr);
}

TEST(what_a_later_version_adds_is_skipped) {
    Mirror mirror;
    (void)mirror.begin();
    Bytes longer = hello(9, 0xfc);
    longer[0] += 3;
    longer.insert(longer.end(), {1, 2, 3});
    give(mirror, longer);
    give(mirror, frame(77, Bytes(100'000, 0xff)));
    give(mirror, anew(0));
    CHECK(mirror.node()->robot == 7);
}

TEST(what_is_no_feed_is_refused_and_the_map_stays) {
    const std::vector<std::pair<const char*, Bytes>> wrong{
        {"length 0", {0, 0, 0, 0, 1}},
        {"length above 1 MiB", {1, 0, 16, 0, 1}},
        {"versions that go back", blocks(1, 9, {})},
        {"newest below upto", blocks(8, 7, {})},
        {"a second hello", hello(9)},
        {"too few blocks", [] { auto b = blocks(3, 3, {1}); b[30] = 2; return b; }()},
        {"a block beyond the grid", blocks(3, 3, {33'554'433})},
        {"free and occupied", [] { auto b = blocks(3, 3, {1}); b[4 + 1 + 29 + 12] = 1; return b; }()},
        {"a truncated counter", frame(5, {0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 5, 'a'})},
        {"a name that is no text", frame(5, {0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 1, 0xff, 0, 0, 0, 0, 0, 0, 0, 0})},
        {"poses that are not there", frame(4, {0xff, 0xff})},
        {"submaps of runs that are not there", frame(10, {0xff, 0x03})},
        {"submaps of too many runs", frame(10, Bytes(100'000, 0xff))},
        {"a run twice", submaps({1, 1}, {0})},
        {"a submap twice", submaps({1}, {0, 3, 3})},
        {"a submap that has not begun", submaps({1}, {0, 10})},
        {"a rotation that would scale", submaps({1}, {0}, 2.0)},
        {"a rotation that is no number", submaps({1}, {0}, std::nan(""))},
        {"a place that is no number", [] { auto s = submaps({1}, {0}); s[23 + 2 + 7] = 0x7f; s[23 + 2 + 6] = 0xf0; return s; }()},
    };
    for (const auto& [name, bytes] : wrong) {
        Mirror mirror;
        (void)mirror.begin();
        give(mirror, hello(9));
        give(mirror, anew(2));
        give(mirror, blocks(2, 2, {0}));
        if (!refuses(mirror, bytes)) {
            throw std::logic_error(std::string("taken: ") + name);
        }
        CHECK(mirror.map().blocks().size() == 1 && mirror.version() == 2);
    }
    Mirror mirror;
    (void)mirror.begin();
    CHECK(refuses(mirror, anew(3)));
}

TEST(no_feed_makes_a_mirror_hold_more_than_it_may) {
    Options options;
    options.blocks_max = 3;
    Mirror mirror(options);
    (void)mirror.begin();
    give(mirror, hello(9));
    give(mirror, anew(9));
    give(mirror, blocks(1, 9, {0, 1, 2}));
    give(mirror, blocks(2, 9, {0, 1, 2}));
    CHECK(refuses(mirror, blocks(3, 9, {3})));
    CHECK(mirror.map().blocks().size() == 3);
}

TEST(damaged_feeds_do_no_harm) {
    const auto node = example().second;
    std::mt19937 random(1);
    int refused = 0;
    for (int round = 0; round < 20'000; ++round) {
        Bytes bytes = node;
        for (int flips = 1 + static_cast<int>(random() % 4); flips > 0; --flips) {
            bytes[random() % bytes.size()] = static_cast<std::uint8_t>(random());
        }
        Mirror mirror;
        (void)mirror.begin();
        refused += refuses(mirror, bytes);
        CHECK(mirror.map().blocks().size() <= 1);
    }
    CHECK(refused > 1'000);
}
