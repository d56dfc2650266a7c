// A mirror of the map of a running node, for planners in C++17. Header only; needs neither libflockmap nor Rust.
//
// Written from docs/map-output.md alone, whose words it uses. `Mirror` takes the bytes of a feed, however they are cut, and
// knows no sockets; `Client` (flockmap_mirror_client.hpp) is that over a Unix socket or TCP. No thread is started; an object
// is for one thread at a time. What is wrong with bytes is a `FeedError`: the connection is of no use then, the map stays.
#ifndef FLOCKMAP_MIRROR_HPP
#define FLOCKMAP_MIRROR_HPP

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <iterator>
#include <optional>
#include <set>
#include <stdexcept>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

namespace flockmap_mirror {

class FeedError : public std::runtime_error {
    using std::runtime_error::runtime_error;
};

enum class State : std::uint8_t { Unknown = 0, Free = 1, Occupied = 2 };

// Index of a voxel or of a block. Voxel (x, y, z) covers x * r to (x + 1) * r metres, and so on.
struct Index {
    std::int32_t x = 0, y = 0, z = 0;

    friend bool operator==(const Index& a, const Index& b) { return a.x == b.x && a.y == b.y && a.z == b.z; }
    friend bool operator<(const Index& a, const Index& b) {
        return std::array{a.x, a.y, a.z} < std::array{b.x, b.y, b.z};
    }
};

struct IndexHash {
    std::size_t operator()(const Index& at) const noexcept {
        std::uint64_t hash = static_cast<std::uint32_t>(at.x);
        for (const std::int32_t next : {at.y, at.z}) {
            hash = (hash ^ (hash >> 29)) * 0xbf58476d1ce4e5b9u + static_cast<std::uint32_t>(next);
        }
        hash = (hash ^ (hash >> 32)) * 0x94d049bb133111ebu;
        return static_cast<std::size_t>(hash ^ (hash >> 31));
    }
};

// 8 x 8 x 8 bits: word z, bit 8 * y + x.
using Plane = std::array<std::uint64_t, 8>;

// Which robot saw which voxels of a block last.
struct Origin {
    std::uint16_t robot = 0;
    Plane voxels{};
};

struct Block {
    Plane free{}, occupied{};
    std::vector<Origin> origins;  // empty unless they were asked for

    State state(int x, int y, int z) const noexcept {
        const std::uint64_t bit = std::uint64_t{1} << (8 * y + x);
        return occupied[static_cast<std::size_t>(z)] & bit ? State::Occupied
               : free[static_cast<std::size_t>(z)] & bit   ? State::Free
                                                           : State::Unknown;
    }
    bool is_empty() const noexcept { return free == Plane{} && occupied == Plane{}; }
};

// Voxels in blocks. Only blocks of which something is known are kept.
class Map {
public:
    using Blocks = std::unordered_map<Index, Block, IndexHash>;

    double resolution_m() const noexcept { return micrometres_ / 1e6; }
    std::uint32_t micrometres() const noexcept { return micrometres_; }
    const Blocks& blocks() const noexcept { return blocks_; }

    // Null if nothing of it is known.
    const Block* block(const Index& index) const {
        const auto found = blocks_.find(index);
        return found == blocks_.end() ? nullptr : &found->second;
    }

    State state(const Index& voxel) const {
        // Of negative numbers too: right shifts go on with the sign, and the lowest bits count up from there.
        const Block* block = this->block({voxel.x >> 3, voxel.y >> 3, voxel.z >> 3});
        return block == nullptr ? State::Unknown : block->state(voxel.x & 7, voxel.y & 7, voxel.z & 7);
    }

    // Unknown where there are no voxels, and for what is no number.
    State state_at(double x, double y, double z) const {
        const auto voxel = voxel_at(x, y, z);
        return voxel ? state(*voxel) : State::Unknown;
    }

    std::optional<Index> voxel_at(double x, double y, double z) const {
        std::array<std::int32_t, 3> at{};
        const std::array<double, 3> point{x, y, z};
        for (std::size_t axis = 0; axis < 3; ++axis) {
            const double index = std::floor(point[axis] * (1e6 / micrometres_));
            if (!(std::abs(index) <= 268'435'456.0)) {
                return std::nullopt;
            }
            at[axis] = static_cast<std::int32_t>(index);
        }
        return Index{at[0], at[1], at[2]};
    }

    std::array<double, 3> centre(const Index& voxel) const noexcept {
        return {(voxel.x + 0.5) * resolution_m(), (voxel.y + 0.5) * resolution_m(), (voxel.z + 0.5) * resolution_m()};
    }

    // Calls visit(Index voxel, State) for each known voxel, in no order.
    template <class Visit>
    void for_each(Visit&& visit) const {
        for (const auto& [index, block] : blocks_) {
            for (int z = 0; z < 8; ++z) {
                const auto at = static_cast<std::size_t>(z);
                for (std::uint64_t rest = block.free[at] | block.occupied[at]; rest != 0; rest &= rest - 1) {
                    const int bit = trailing_zeros(rest);
                    const Index voxel{index.x * 8 + (bit & 7), index.y * 8 + (bit >> 3), index.z * 8 + z};
                    visit(voxel, block.state(bit & 7, bit >> 3, z));
                }
            }
        }
    }

private:
    friend class Mirror;

    static int trailing_zeros(std::uint64_t word) noexcept {
        int bit = 0;
        for (int step = 32; step > 0; step /= 2) {
            if ((word & ((std::uint64_t{1} << step) - 1)) == 0) {
                word >>= step;
                bit += step;
            }
        }
        return bit;
    }

    std::uint32_t micrometres_ = 100'000;
    Blocks blocks_;
    std::size_t origins_ = 0;
};

// Where a robot was when its scan or batch was made.
struct RobotPose {
    std::uint16_t robot = 0;
    std::uint64_t epoch = 0;
    std::array<double, 3> position_m{};
    bool is_turned = false;  // whether the quaternion is known
    std::array<double, 4> quaternion_xyzw{};
    std::uint64_t age_us = 0;
};

// How a submap lies in the map: T_own_submap, as docs/map-output.md says it, kind 10.
struct SubmapPose {
    std::uint16_t submap = 0;
    std::array<double, 3> position_m{};
    std::array<double, 4> quaternion_xyzw{};
};

// The submaps of one run of a robot: 0 to `newest`.
struct RunSubmaps {
    std::uint16_t robot = 0;
    std::uint64_t epoch = 0;
    std::uint16_t newest = 0;
    std::uint16_t left_out = 0;     // poses of older submaps for which there was no room
    std::vector<SubmapPose> poses;  // ascending; a submap that is not there lies as the one before it

    // Null if it has not begun, or its pose was left out.
    const SubmapPose* pose(std::uint16_t submap) const {
        const auto is_after = [](std::uint16_t number, const SubmapPose& pose) { return number < pose.submap; };
        const auto after = std::upper_bound(poses.begin(), poses.end(), submap, is_after);
        return submap > newest || after == poses.begin() ? nullptr : &*std::prev(after);
    }
};

// Who gives the map.
struct NodeInfo {
    std::uint16_t robot = 0;
    std::uint32_t micrometres = 0;
    std::uint64_t feed = 0;
    bool has_origins = false;
    std::string name, frame;
};

struct Options {
    bool wants_origins = false;
    bool wants_submaps = false;
    std::size_t blocks_max = std::size_t{1} << 20;   // of a map; a new one may stand beside the old one for a while
    std::size_t origins_max = std::size_t{1} << 22;  // of all blocks of a map
};

class Mirror {
public:
    explicit Mirror(Options options = {}) : options_(options) {}

    // Begins a connection: forgets what was not complete of the last one. The bytes are to be sent.
    std::vector<std::uint8_t> begin() {
        buffer_.clear();
        has_hello_ = has_ended_ = waits_for_anew_ = has_blocks_ = false;
        std::vector<std::uint8_t> bytes;
        put(bytes, 31, 4);
        const int flags = (options_.wants_origins ? 1 : 0) + (options_.wants_submaps ? 16 : 0);
        bytes.insert(bytes.end(), {1, 'F', 'L', 'K', 'M', 1, static_cast<std::uint8_t>(flags)});
        put(bytes, feed_, 8);
        put(bytes, began_, 8);
        put(bytes, upto_, 8);
        return bytes;
    }

    // Takes in bytes of the node. Each frame is taken as a whole or not at all; after a FeedError nothing more is taken until
    // `begin`.
    void receive(const std::uint8_t* bytes, std::size_t length) {
        // In parts, so that what is held is never much more than a frame.
        while (length > 0) {
            const std::size_t part = std::min<std::size_t>(length, 65'536);
            buffer_.insert(buffer_.end(), bytes, bytes + part);
            bytes += part;
            length -= part;
            take_frames();
        }
    }

    // The map as it is shown: whole after the first time, even while the node begins anew.
    const Map& map() const noexcept { return shown_; }

    // Whether the map is the node's as it was at version `version()`, voxel by voxel.
    bool is_caught_up() const noexcept { return has_blocks_ && !coming_ && !waits_for_anew_ && upto_ == newest_; }

    std::uint64_t version() const noexcept { return upto_; }
    std::uint64_t newest() const noexcept { return newest_; }
    std::int64_t stamp_us() const noexcept { return stamp_us_; }        // when the node's map came to `newest`
    std::uint64_t changes() const noexcept { return changes_; }         // goes up each time the shown map changes
    const std::optional<NodeInfo>& node() const noexcept { return node_; }  // empty before the first hello
    const std::vector<RobotPose>& robots() const noexcept { return robots_; }
    const std::vector<std::pair<std::string, std::uint64_t>>& counters() const noexcept { return counters_; }
    // Ascending by robot and epoch, as said last; empty unless they were asked for.
    const std::vector<RunSubmaps>& submaps() const noexcept { return submaps_; }
    // Why the node ended this connection; empty if it did not.
    const std::optional<std::string>& end() const noexcept { return end_; }
    bool has_ended() const noexcept { return has_ended_; }

private:
    static constexpr std::size_t kFrameMax = 1'048'576;
    static constexpr std::int32_t kBlockIndexMax = 33'554'432;
    static constexpr std::size_t kRunsMax = 1'024, kSubmapPosesMax = 8'192, kSubmapsMax = 4'096;

    // Reads a body from its beginning to its end.
    struct Reader {
        const std::uint8_t* at;
        std::size_t left;

        const std::uint8_t* take(std::size_t bytes) {
            if (bytes > left) {
                throw FeedError("a frame ends before what it says is in it");
            }
            const std::uint8_t* taken = at;
            at += bytes;
            left -= bytes;
            return taken;
        }
        std::uint64_t number(std::size_t bytes) {
            const std::uint8_t* from = take(bytes);
            std::uint64_t value = 0;
            for (std::size_t i = bytes; i-- > 0;) {
                value = value << 8 | from[i];
            }
            return value;
        }
        std::int64_t i64() { return static_cast<std::int64_t>(number(8)); }
        double f64() {
            const std::uint64_t bits = number(8);
            double value;
            std::memcpy(&value, &bits, sizeof value);
            return value;
        }
        Plane plane() {
            Plane plane;
            for (auto& word : plane) {
                word = number(8);
            }
            return plane;
        }
        std::string text(std::size_t bytes) {
            const auto* from = reinterpret_cast<const char*>(take(bytes));
            std::string text(from, bytes);
            if (!is_utf8(text)) {
                throw FeedError("a text is no UTF-8");
            }
            return text;
        }
    };

    static void put(std::vector<std::uint8_t>& bytes, std::uint64_t value, int count) {
        for (int i = 0; i < count; ++i) {
            bytes.push_back(static_cast<std::uint8_t>(value >> (8 * i)));
        }
    }

    static bool is_utf8(const std::string& text) {
        for (std::size_t at = 0; at < text.size();) {
            const auto byte = [&](std::size_t i) { return at + i < text.size() ? static_cast<unsigned char>(text[at + i]) : 0u; };
            const unsigned first = byte(0);
            const std::size_t more = first < 0x80 ? 0 : first >> 5 == 6 ? 1 : first >> 4 == 14 ? 2 : first >> 3 == 30 ? 3 : 9;
            if (more == 9) {
                return false;
            }
            std::uint32_t code = more == 0 ? first : first & (0x3fu >> more);
            for (std::size_t i = 1; i <= more; ++i) {
                if ((byte(i) & 0xc0) != 0x80) {
                    return false;
                }
                code = code << 6 | (byte(i) & 0x3f);
            }
            constexpr std::uint32_t least[] = {0, 0x80, 0x800, 0x10000};
            if (code < least[more] || code > 0x10ffff || (code >= 0xd800 && code < 0xe000)) {
                return false;
            }
            at += more + 1;
        }
        return true;
    }

    void take_frames() {
        std::size_t done = 0;
        while (buffer_.size() - done >= 4 && !has_ended_) {
            Reader length_reader{buffer_.data() + done, 4};
            const auto length = static_cast<std::size_t>(length_reader.number(4));
            if (length < 1 || length > kFrameMax) {
                throw FeedError("a frame of " + std::to_string(length) + " bytes, expected 1 to 1,048,576: this is no feed");
            }
            if (buffer_.size() - done - 4 < length) {
                break;
            }
            take_frame(buffer_[done + 4], {buffer_.data() + done + 5, length - 1});
            done += 4 + length;
        }
        buffer_.erase(buffer_.begin(), has_ended_ ? buffer_.end() : buffer_.begin() + static_cast<std::ptrdiff_t>(done));
    }

    void take_frame(std::uint8_t kind, Reader body) {
        if (!has_hello_ && kind != 1 && kind != 6) {
            throw FeedError("a frame of kind " + std::to_string(kind) + " before the hello of the node");
        }
        switch (kind) {
            case 1: return hello(body);
            case 2: return blocks(body);
            case 3: return anew(body);
            case 4: return poses(body);
            case 5: return count(body);
            case 6:
                end_ = body.text(body.left);
                has_ended_ = true;
                return;
            case 10: return submaps(body);
            default: return;  // of a later version
        }
    }

    void hello(Reader body) {
        if (has_hello_) {
            throw FeedError("a second hello");
        }
        if (std::memcmp(body.take(4), "FLKM", 4) != 0) {
            throw FeedError("the hello has another magic: this is no feed");
        }
        if (const auto version = body.number(1); version != 1) {
            throw FeedError("the node speaks version " + std::to_string(version) + " of the feed, and this mirror version 1");
        }
        const auto flags = body.number(1);
        NodeInfo node;
        node.has_origins = flags & 1;
        node.robot = static_cast<std::uint16_t>(body.number(2));
        node.micrometres = static_cast<std::uint32_t>(body.number(4));
        node.feed = body.number(8);
        node.name = body.text(static_cast<std::size_t>(body.number(1)));
        node.frame = body.text(static_cast<std::size_t>(body.number(1)));
        if (node.micrometres == 0 || node.feed == 0) {
            throw FeedError("the hello has a voxel without a side, or a feed without an id");
        }
        const bool goes_on = flags & 2;
        const Map& own = coming_ ? *coming_ : shown_;
        if (goes_on && (node.feed != feed_ || node.micrometres != own.micrometres_)) {
            throw FeedError("the node goes on from what this mirror does not have");
        }
        waits_for_anew_ = !goes_on;
        has_hello_ = true;
        node_ = std::move(node);
        end_.reset();
    }

    void anew(Reader body) {
        began_ = body.number(8);
        feed_ = node_->feed;
        upto_ = 0;
        newest_ = began_;
        waits_for_anew_ = has_blocks_ = false;
        Map fresh;
        fresh.micrometres_ = node_->micrometres;
        if (shown_.blocks_.empty()) {
            coming_.reset();
            shown_ = std::move(fresh);
            ++changes_;
        } else {
            coming_ = std::move(fresh);
        }
        show_if_whole();
    }

    void blocks(Reader body) {
        if (waits_for_anew_) {
            throw FeedError("a blocks frame where the map has to begin anew first");
        }
        const std::uint64_t upto = body.number(8), newest = body.number(8);
        const std::int64_t stamp_us = body.i64();
        const bool with_origins = body.number(1) & 1;
        const auto count = static_cast<std::size_t>(body.number(4));
        if (upto < upto_ || newest < upto) {
            throw FeedError("a blocks frame up to version " + std::to_string(upto) + " of " + std::to_string(newest) +
                            ", after one up to " + std::to_string(upto_));
        }
        if (count > body.left / 140) {
            throw FeedError("a blocks frame ends before its last block");
        }
        // All of them are read before the first is taken over.
        std::vector<std::pair<Index, Block>> read;
        read.reserve(count);
        for (std::size_t i = 0; i < count; ++i) {
            read.push_back(block(body, with_origins));
        }
        Map& map = coming_ ? *coming_ : shown_;
        check_room(map, read);
        for (auto& [index, block] : read) {
            auto& origins = map.origins_;
            if (const auto old = map.blocks_.find(index); old != map.blocks_.end()) {
                origins -= old->second.origins.size();
                if (block.is_empty()) {
                    map.blocks_.erase(old);
                    continue;
                }
                origins += block.origins.size();
                old->second = std::move(block);
            } else if (!block.is_empty()) {
                origins += block.origins.size();
                map.blocks_.emplace(index, std::move(block));
            }
        }
        upto_ = upto;
        newest_ = newest;
        stamp_us_ = stamp_us;
        has_blocks_ = true;
        changes_ += !coming_ && count > 0;
        show_if_whole();
    }

    std::pair<Index, Block> block(Reader& body, bool with_origins) const {
        Index index;
        for (auto* axis : {&index.x, &index.y, &index.z}) {
            *axis = static_cast<std::int32_t>(static_cast<std::uint32_t>(body.number(4)));
            if (*axis < -kBlockIndexMax || *axis > kBlockIndexMax) {
                throw FeedError("a block at " + std::to_string(*axis) + ", which is beyond the grid");
            }
        }
        Block block;
        block.free = body.plane();
        block.occupied = body.plane();
        Plane known;
        for (std::size_t z = 0; z < 8; ++z) {
            if (block.free[z] & block.occupied[z]) {
                throw FeedError("a voxel is free and occupied");
            }
            known[z] = block.free[z] | block.occupied[z];
        }
        if (with_origins) {
            origins(body, known, block.origins);
        }
        return {index, std::move(block)};
    }

    static void origins(Reader& body, const Plane& known, std::vector<Origin>& all) {
        const auto count = static_cast<std::size_t>(body.number(2));
        if (count > 512) {
            throw FeedError("more robots saw a block than it has voxels");
        }
        Plane rest = known;
        std::set<std::uint16_t> robots;
        for (std::size_t i = 0; i < count; ++i) {
            Origin origin;
            origin.robot = static_cast<std::uint16_t>(body.number(2));
            origin.voxels = count == 1 ? known : body.plane();
            if (!robots.insert(origin.robot).second) {
                throw FeedError("a robot comes twice among those that saw a block");
            }
            for (std::size_t z = 0; z < 8; ++z) {
                if (origin.voxels[z] & ~rest[z]) {
                    throw FeedError("two robots saw a voxel last, or one saw what nobody knows");
                }
                rest[z] &= ~origin.voxels[z];
            }
            all.push_back(origin);
        }
        if (count > 0 && rest != Plane{}) {
            throw FeedError("nobody saw a voxel that is known");
        }
    }

    // What is held after these blocks, at the most.
    void check_room(const Map& map, const std::vector<std::pair<Index, Block>>& read) const {
        std::size_t blocks = map.blocks_.size(), origins = map.origins_;
        for (const auto& [index, block] : read) {
            blocks += !block.is_empty() && map.blocks_.find(index) == map.blocks_.end();
            origins += block.origins.size();
        }
        if (blocks > options_.blocks_max || origins > options_.origins_max) {
            throw FeedError("the map has more than " + std::to_string(options_.blocks_max) + " blocks or " +
                            std::to_string(options_.origins_max) + " origins: allow more of them");
        }
    }

    // A new map takes the place of the old one once it has all that the node's had when it began.
    void show_if_whole() {
        if (coming_ && upto_ >= began_) {
            shown_ = std::move(*coming_);
            coming_.reset();
            ++changes_;
        }
    }

    void poses(Reader body) {
        const auto count = static_cast<std::size_t>(body.number(2));
        std::vector<RobotPose> robots;
        for (std::size_t i = 0; i < count; ++i) {
            RobotPose pose;
            pose.robot = static_cast<std::uint16_t>(body.number(2));
            pose.epoch = body.number(8);
            for (auto& metres : pose.position_m) {
                metres = body.f64();
            }
            pose.is_turned = body.number(1) == 1;
            for (auto& part : pose.quaternion_xyzw) {
                part = body.f64();
            }
            pose.age_us = body.number(8);
            robots.push_back(pose);
        }
        robots_ = std::move(robots);
    }

    void count(Reader body) {
        body.take(8);  // the time, which the stamps of blocks have too
        const auto number = static_cast<std::size_t>(body.number(2));
        std::vector<std::pair<std::string, std::uint64_t>> counters;
        for (std::size_t i = 0; i < number; ++i) {
            auto name = body.text(static_cast<std::size_t>(body.number(1)));
            counters.emplace_back(std::move(name), body.number(8));
        }
        counters_ = std::move(counters);
    }

    void submaps(Reader body) {
        const auto count = static_cast<std::size_t>(body.number(2));
        if (count > kRunsMax) {
            throw FeedError("submaps of " + std::to_string(count) + " runs, expected 1,024 at most");
        }
        std::vector<RunSubmaps> runs;
        std::size_t room = kSubmapPosesMax;
        for (std::size_t i = 0; i < count; ++i) {
            RunSubmaps run;
            run.robot = static_cast<std::uint16_t>(body.number(2));
            run.epoch = body.number(8);
            run.newest = static_cast<std::uint16_t>(body.number(2));
            run.left_out = static_cast<std::uint16_t>(body.number(2));
            const auto poses = static_cast<std::size_t>(body.number(2));
            if (run.newest >= kSubmapsMax || poses > room) {
                throw FeedError("more than 4,096 submaps of a run, or more than 8,192 poses of submaps");
            }
            if (!runs.empty() && std::pair(runs.back().robot, runs.back().epoch) >= std::pair(run.robot, run.epoch)) {
                throw FeedError("runs whose submaps are told do not ascend");
            }
            room -= poses;
            for (std::size_t k = 0; k < poses; ++k) {
                const SubmapPose pose = submap_pose(body);
                if (pose.submap > run.newest || (!run.poses.empty() && pose.submap <= run.poses.back().submap)) {
                    throw FeedError("submaps of a run do not ascend to its newest one");
                }
                run.poses.push_back(pose);
            }
            runs.push_back(std::move(run));
        }
        submaps_ = std::move(runs);
    }

    static SubmapPose submap_pose(Reader& body) {
        SubmapPose pose;
        pose.submap = static_cast<std::uint16_t>(body.number(2));
        bool is_finite = true;
        for (auto& metres : pose.position_m) {
            metres = body.f64();
            is_finite = is_finite && std::isfinite(metres);
        }
        double square = 0.0;
        for (auto& part : pose.quaternion_xyzw) {
            part = body.f64();
            square += part * part;
        }
        if (!is_finite || !(std::abs(square - 1.0) <= 1e-3)) {
            throw FeedError("the pose of a submap is none");
        }
        return pose;
    }

    Options options_;
    std::vector<std::uint8_t> buffer_;
    bool has_hello_ = false, has_ended_ = false, waits_for_anew_ = false, has_blocks_ = false;
    std::uint64_t feed_ = 0, began_ = 0, upto_ = 0, newest_ = 0, changes_ = 0;
    std::int64_t stamp_us_ = 0;
    Map shown_;
    std::optional<Map> coming_;
    std::optional<NodeInfo> node_;
    std::vector<RobotPose> robots_;
    std::vector<std::pair<std::string, std::uint64_t>> counters_;
    std::vector<RunSubmaps> submaps_;
    std::optional<std::string> end_;
};

}  // namespace flockmap_mirror

#endif
