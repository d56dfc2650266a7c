/* Flockmap for C: keeps the 3-D occupancy map of every robot of a swarm in sync over a thin, lossy radio.
 *
 * Made by cbindgen from bindings/c/src: do not edit. docs/cpp.md begins with a whole program.
 *
 * What holds for every function:
 *
 * - The caller owns sockets, threads, clocks and buffers. Nothing is called back, and no thread is started.
 * - A result of 0 or more is no error; FLOCKMAP_NONE (1) is "there is nothing". After an error flockmap_last_error() has
 *   a text for this thread. An error changes nothing but what a function says.
 * - Any thread may call any function. A robot and a field do one change at a time, others wait; a view and frontiers never
 *   change. Only flockmap_*_free wants that nobody else uses the handle any more.
 * - A handle or a buffer that is null is FLOCKMAP_ERROR_NULL, unless the function says that it may be; a buffer of 0
 *   elements may always be null. A length counts elements: points, voxels, bytes; a point of 3 numbers is one.
 * - A buffer must lie where its type wants it and be as long as said; buffers of a call that are written to may not
 *   overlap others. What can be seen of that is FLOCKMAP_ERROR_ARGUMENT; a pointer to what is not there cannot be seen.
 * - Numbers that are not finite, enums that are unknown, texts that are no UTF-8 and lengths that no memory has are errors,
 *   never undefined behaviour. A fault of the library is FLOCKMAP_ERROR_INTERNAL, and the handle is of no more use then.
 * - Buffers are read or written during the call only. Handles that a function makes are the caller's to free.
 * - Coordinates are metres in the frame of the robot's map; times are microseconds on the robot's clock; poses are 4 x 4
 *   matrices, row by row: T_a_b takes a point in frame b to frame a.
 */


#ifndef FLOCKMAP_H
#define FLOCKMAP_H



#include <stddef.h>
#include <stdint.h>

#define FLOCKMAP_VERSION_MAJOR 0
#define FLOCKMAP_VERSION_MINOR 1
#define FLOCKMAP_VERSION_PATCH 0

// Bytes of the text of an event, with the 0 at its end.
#define FLOCKMAP_EVENT_TEXT_BYTES 256

// Most points of a scan, with its rays without a return.
#define FLOCKMAP_SCAN_POINTS_MAX (1 << 24)

// Bytes of the largest datagram: the room that flockmap_robot_poll_transmit needs.
#define FLOCKMAP_DATAGRAM_BYTES_MAX 1200

// What became of a call. 0 or more is no error.
enum flockmap_result
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Done.
  FLOCKMAP_OK = 0,
  // There is nothing (any more): no datagram to send, no event, no such block, an empty map. Outputs are not
  // written.
  FLOCKMAP_NONE = 1,
  // A pointer is null that may not be.
  FLOCKMAP_ERROR_NULL = -1,
  // A length, a number, a pose or a text is none that can be.
  FLOCKMAP_ERROR_ARGUMENT = -2,
  // The buffer is too small. Where a `count` is asked for, it says how much is needed.
  FLOCKMAP_ERROR_BUFFER = -3,
  // The options contradict each other, or one of them is out of its range.
  FLOCKMAP_ERROR_CONFIG = -4,
  // A datagram is damaged, foreign or forged. It is counted already; go on with the next one.
  FLOCKMAP_ERROR_DATAGRAM = -5,
  // More is asked for than may be at once.
  FLOCKMAP_ERROR_TOO_LARGE = -6,
  // A file could not be read or written, or is none of its kind.
  FLOCKMAP_ERROR_FILE = -7,
  // An earlier call failed inside of this handle, and it is of no more use: free it.
  FLOCKMAP_ERROR_POISONED = -8,
  // A fault of the library; please report it. The handle is poisoned.
  FLOCKMAP_ERROR_INTERNAL = -9,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_result flockmap_result;
#else
typedef int32_t flockmap_result;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// Whose rules the mapper follows: flockmap_robot_options.mapper.
enum flockmap_mapper_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // ROG-Map: every ray counts, and hits win over the misses of the same scan. The default.
  FLOCKMAP_MAPPER_KIND_ROG_MAP = 0,
  // RACER: one update for a voxel and scan; the first touch decides.
  FLOCKMAP_MAPPER_KIND_RACER = 1,
  // OctoMap's insertPointCloud with its default sensor model.
  FLOCKMAP_MAPPER_KIND_OCTOMAP = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_mapper_kind flockmap_mapper_kind;
#else
typedef int32_t flockmap_mapper_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What is known of a voxel, as an uint8_t in arrays.
enum flockmap_voxel_state
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Never observed, or observed without a decision.
  FLOCKMAP_VOXEL_STATE_UNKNOWN = 0,
  // Observed to be empty.
  FLOCKMAP_VOXEL_STATE_FREE = 1,
  // Observed to hold an obstacle.
  FLOCKMAP_VOXEL_STATE_OCCUPIED = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_voxel_state flockmap_voxel_state;
#else
typedef int32_t flockmap_voxel_state;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What an event is about: flockmap_event.kind. Later versions may have more.
enum flockmap_event_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // One that this version has no number for.
  FLOCKMAP_EVENT_KIND_OTHER = 0,
  // An own batch was closed and is going out. `count`: voxels that changed; `index`: packages made of it.
  FLOCKMAP_EVENT_KIND_BATCH_CLOSED = 1,
  // A package of another robot is in the fused map. `count`: voxels taken over; `index`: its number.
  FLOCKMAP_EVENT_KIND_MERGED = 2,
  // A package was not taken in, and is asked for again unless that is useless. `index`: its number; `text`: why.
  FLOCKMAP_EVENT_KIND_REFUSED = 3,
  // Packages that never came are known from a snapshot.
  FLOCKMAP_EVENT_KIND_SNAPSHOT_CONTAINS = 4,
  // All packages up to `index` are held now, by a snapshot.
  FLOCKMAP_EVENT_KIND_CAUGHT_UP = 5,
  // A robot was heard for the first time, or again, or in a new run.
  FLOCKMAP_EVENT_KIND_PEER_SEEN = 6,
  // A robot has not been heard for a while.
  FLOCKMAP_EVENT_KIND_PEER_LOST = 7,
  // An ended run of a robot was forgotten: there were too many.
  FLOCKMAP_EVENT_KIND_RUN_FORGOTTEN = 8,
  // The own id was used with a higher epoch; this robot has begun anew above that, with `epoch`.
  FLOCKMAP_EVENT_KIND_RUN_BEGUN = 9,
  // Another robot uses the own id. Give one of them another.
  FLOCKMAP_EVENT_KIND_SAME_IDENTITY = 10,
  // With a swarm key: this run can send no more. Make a new robot.
  FLOCKMAP_EVENT_KIND_NONCES_EXHAUSTED = 11,
  // Own changes could not be coded. Please report it. `text`: why.
  FLOCKMAP_EVENT_KIND_ENCODE_FAILED = 12,
  // For want of room `count` blocks of a layer were dropped, or did not come in: the farthest and oldest.
  FLOCKMAP_EVENT_KIND_DROPPED = 13,
  // Of a stream of which something was lacking all has come.
  FLOCKMAP_EVENT_KIND_COMPLETE = 14,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_event_kind flockmap_event_kind;
#else
typedef int32_t flockmap_event_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// Which voxels are obstacles.
enum flockmap_obstacle_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // What was seen to be Occupied. Unknown counts as free.
  FLOCKMAP_OBSTACLE_KIND_OCCUPIED = 0,
  // Whatever was not seen to be Free: Occupied and Unknown.
  FLOCKMAP_OBSTACLE_KIND_NOT_FREE = 1,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_obstacle_kind flockmap_obstacle_kind;
#else
typedef int32_t flockmap_obstacle_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// What flockmap_field_update did.
enum flockmap_update_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // Nothing: no block of the box had changed.
  FLOCKMAP_UPDATE_KIND_UNCHANGED = 0,
  // What depends on the blocks that had changed.
  FLOCKMAP_UPDATE_KIND_PARTLY = 1,
  // All of it.
  FLOCKMAP_UPDATE_KIND_ANEW = 2,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_update_kind flockmap_update_kind;
#else
typedef int32_t flockmap_update_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// When a cell of an occupancy grid is Free, of whose column no voxel is Occupied.
enum flockmap_column_kind
#if defined(__cplusplus) || __STDC_VERSION__ >= 202311L
  : int32_t
#endif // defined(__cplusplus) || __STDC_VERSION__ >= 202311L
 {
  // At least one voxel of its column is Free, as octomap_server projects.
  FLOCKMAP_COLUMN_KIND_ANY_FREE = 0,
  // Every voxel of its column is Free: for a robot that fills the band.
  FLOCKMAP_COLUMN_KIND_ALL_FREE = 1,
};
#ifndef __cplusplus
#if __STDC_VERSION__ >= 202311L
typedef enum flockmap_column_kind flockmap_column_kind;
#else
typedef int32_t flockmap_column_kind;
#endif // __STDC_VERSION__ >= 202311L
#endif // __cplusplus

// How far the nearest obstacle of a box is, from centre to centre, for each voxel of it. Obstacles outside of the box do
// not count. Opaque; any thread may call any function with it: questions go on at the same time, updates alone.
typedef struct flockmap_field flockmap_field;

// The frontiers of a box. Opaque and never changed: any number of threads may ask it at once.
typedef struct flockmap_frontiers flockmap_frontiers;

// A robot of the swarm. Opaque; any thread may call any function with it at any time, one call at a time is done.
typedef struct flockmap_robot flockmap_robot;

// A map as it was at one moment. Opaque and never changed: any number of threads may ask it at once.
typedef struct flockmap_view flockmap_view;

// Something worth knowing. What does not belong to its kind is 0.
typedef struct flockmap_event {
  // Run of the robot that it is about.
  uint64_t epoch;
  // See the kinds.
  uint64_t count;
  // See the kinds.
  uint32_t index;
  // One of flockmap_event_kind.
  int32_t kind;
  // Id of the robot that it is about.
  uint16_t origin;
  // A text in UTF-8, "" for most kinds. Longer ones are cut.
  char text[FLOCKMAP_EVENT_TEXT_BYTES];
} flockmap_event;

// What a robot counted since it was made.
typedef struct flockmap_counters {
  // Scans taken in.
  uint64_t scans;
  // Of these: with a stamp ahead of the robot's clock.
  uint64_t scans_ahead;
  // Updates with states of voxels taken in.
  uint64_t states;
  // Points that were ignored: not finite, too near or too far out.
  uint64_t points_ignored;
  // Points that were taken for team-mates.
  uint64_t points_masked;
  // Blocks of the own map that were forgotten under map_bytes_max.
  uint64_t blocks_forgotten;
  // Batches closed.
  uint64_t batches;
  // Own voxels that changed, added up over batches.
  uint64_t changes;
  // Own packages made.
  uint64_t packages;
  // Bytes of these.
  uint64_t package_bytes;
  // Packages of others merged.
  uint64_t merged;
  // Packages of others that were damaged.
  uint64_t damaged;
  // Packages of others for which there was no room.
  uint64_t no_room;
  // Packages of others with voxels of another size: give all robots the same resolution.
  uint64_t foreign_resolution;
  // Snapshots made for others.
  uint64_t snapshots;
  // Events dropped since nobody polled them.
  uint64_t events_dropped;
  // Datagrams that went out.
  uint64_t datagrams_out;
  // Bytes of these, without headers of IP and UDP.
  uint64_t bytes_out;
  // Own packages that were found lost.
  uint64_t lost;
  // Packages of others that came after they had been lost once.
  uint64_t repaired;
  // Datagrams that were damaged on the way.
  uint64_t datagrams_damaged;
  // Datagrams that made no sense.
  uint64_t datagrams_malformed;
  // Datagrams of other swarms.
  uint64_t datagrams_foreign;
  // With a swarm key: datagrams that nobody with the key made.
  uint64_t datagrams_forged;
  // Blocks of layers that were dropped for want of room, or did not come in.
  uint64_t blocks_dropped;
} flockmap_counters;

// Voxels from `low` on, `size` of them along x, y, z. A voxel (x, y, z) covers x * r to (x + 1) * r metres, and so on,
// with r the side of a voxel. Indices go to 2^28 in both directions.
typedef struct flockmap_box {
  // Index of the lowest voxel.
  int32_t low[3];
  // Voxels along x, y, z; 1 or more.
  uint32_t size[3];
} flockmap_box;

// One frontier: Free voxels beside Unknown ones, near each other.
typedef struct flockmap_frontier {
  // The middle of the centres of its voxels in metres, in the frame of the map.
  double centroid_m[3];
  // Voxels of it.
  size_t voxels;
  // The smallest box that holds them.
  struct flockmap_box bounds;
} flockmap_frontier;

// What most robots need to say. flockmap_robot_new_from_toml takes all options.
typedef struct flockmap_robot_options {
  // Number of this run, which no two runs of a robot may share: flockmap_epoch makes one. 0 (default): made of the
  // system's clock and random bits.
  uint64_t epoch;
  // Moves requests of different robots apart in time; the same for all will do. Default 0.
  uint64_t seed;
  // Side of a voxel in metres, 0.001 to 100; the same for all robots of a swarm. Default 0.1.
  double resolution_m;
  // Longer rays are cut here. Metres, above 0, at most 500 voxels. Default 7.
  double range_m;
  // Nearer points are ignored: the robot's own body. Metres. Default 0.
  double range_min_m;
  // Bytes of the own map; the blocks farthest away are forgotten beyond it. Default 512 MiB.
  uint64_t map_bytes_max;
  // One of flockmap_mapper_kind. Default FLOCKMAP_MAPPER_KIND_ROG_MAP.
  int32_t mapper;
  // Changes are packed after so many milliseconds, 1 or more. Default 500.
  uint32_t publish_period_ms;
  // Obstacles go out after so many milliseconds, ahead of free space. 0 (default): both together.
  uint32_t obstacle_period_ms;
  // Bytes that may go out in a second, over all links; 0: no limit. Default 2,000,000.
  uint32_t radio_bytes_per_s;
  // Bytes that may go out to one robot in a second; 0 (default): no limit.
  uint32_t link_bytes_per_s;
  // Number of this robot, 0 to 65535. No two robots of a swarm may have the same. Default 1.
  uint16_t id;
  // Robots of other swarms are ignored. Default 0.
  uint16_t swarm;
  // 0 (default): a datagram for each robot; 1: one for all, by broadcast or multicast.
  uint8_t broadcast;
  // Whether swarm_key is given, 0 (default) or 1. Without, anybody in reach of the radio can read and change the map.
  uint8_t has_swarm_key;
  // The secret of the swarm, from a random generator.
  uint8_t swarm_key[32];
} flockmap_robot_options;

// What became of a scan, or of an update with states.
typedef struct flockmap_scan_report {
  // Rays that ended with a hit.
  size_t hits;
  // Rays that were cut, or came back with nothing: they carve free space only.
  size_t cut;
  // Points that were ignored: not finite, too near, or too far out.
  size_t ignored;
  // Points that were ignored since they lie on a team-mate.
  size_t masked;
  // Voxels that are Free or Occupied now and were not before.
  size_t changed;
  // Blocks that were forgotten under map_bytes_max.
  size_t forgotten;
} flockmap_scan_report;

// What one run of one robot has said so far.
typedef struct flockmap_layer {
  // Number of the run.
  uint64_t epoch;
  // A number that two robots share for a stream when they hold the same of it.
  uint64_t digest;
  // Newest stamp of what it says, on the own clock; the lowest number if it says nothing.
  int64_t newest_us;
  // Voxels of it that are known.
  size_t voxels;
  // Id of the robot.
  uint16_t origin;
} flockmap_layer;

// Where a datagram goes.
typedef struct flockmap_transmit {
  // The number of the address that it goes to, if has_path.
  uint64_t path;
  // Bytes of it.
  size_t length;
  // The robot that it is for, unless to_everyone.
  uint16_t peer;
  // 1: it goes to everyone: the broadcast or multicast address, or each address that is known, beginning with
  // another one each time, since a full queue takes the first only.
  uint8_t to_everyone;
  // 1: it goes to one address, that from which the datagrams of `path` were heard. If neither is 1, the robot's
  // datagrams were given without a path, and the caller knows where `peer` is.
  uint8_t has_path;
} flockmap_transmit;

// What a view is, in a few numbers.
typedef struct flockmap_view_summary {
  // Goes up with each change of a block.
  uint64_t version;
  // Side of a voxel in metres.
  double resolution_m;
  // Voxels that are Free.
  size_t free;
  // Voxels that are Occupied.
  size_t occupied;
  // Blocks of 8 x 8 x 8 voxels of which something is known.
  size_t blocks;
  // Bytes that it takes, most of them shared with the views before and after it.
  size_t memory_bytes;
} flockmap_view_summary;

// Where a ray ended.
typedef struct flockmap_ray_hit {
  // Metres from its start to where it enters the voxel; infinity if it reached its end.
  double distance_m;
  // The voxel, unless it reached its end.
  int32_t voxel[3];
  // FLOCKMAP_VOXEL_STATE_OCCUPIED or _UNKNOWN for what it met, _FREE if it reached its end.
  int32_t state;
} flockmap_ray_hit;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Whether spheres of a radius meet an obstacle, taken as full cubes, exactly; touching counts.
//
// `obstacles`: one of flockmap_obstacle_kind. `centres`: `count` times x, y, z, metres in the frame of the map.
// `collides`: room for `count`, 1 or 0. FLOCKMAP_ERROR_ARGUMENT for a number that is not finite, negative or beyond the
// grid, FLOCKMAP_ERROR_TOO_LARGE for a sphere that meets more than 2^20 blocks; `collides` is written up to there. Any
// thread.
flockmap_result flockmap_view_spheres(const struct flockmap_view *view,
                                      int32_t obstacles,
                                      const double *centres,
                                      size_t count,
                                      double radius_m,
                                      uint8_t *collides);

// What spheres of a radius meet first on straight ways of their centres.
//
// `from`, `to`: `count` times x, y, z. `along_m`: room for `count`: metres that the centre has gone by then, 0 if it
// began in touch, infinity if nothing is in the way. `voxels`: room for `count` times x, y, z, the obstacle, 0 if there
// is none; null if not wanted. The rest as for flockmap_view_spheres. Any thread.
flockmap_result flockmap_view_segments(const struct flockmap_view *view,
                                       int32_t obstacles,
                                       const double *from,
                                       const double *to,
                                       size_t count,
                                       double radius_m,
                                       double *along_m,
                                       int32_t *voxels);

// The next event; FLOCKMAP_NONE if there is none. Need not be polled: what is not read is dropped, oldest first.
// `event` is the caller's. Any thread.
flockmap_result flockmap_robot_poll_event(struct flockmap_robot *robot,
                                          struct flockmap_event *event);

// What a robot counted. `counters` is the caller's. Any thread.
flockmap_result flockmap_robot_counters(const struct flockmap_robot *robot,
                                        struct flockmap_counters *counters);

// Makes the field of a box. `obstacles`: one of flockmap_obstacle_kind. `memory_max`: bytes that it may take, 6 to 12
// for each voxel; 0: 256 MiB. FLOCKMAP_ERROR_TOO_LARGE if it would take more, or if the box is longer than 4,096 voxels
// from corner to corner. `*field` is to be freed by flockmap_field_free; null on an error. The view is not kept. Any
// thread.
flockmap_result flockmap_field_new(const struct flockmap_view *view,
                                   const struct flockmap_box *region,
                                   int32_t obstacles,
                                   uint64_t memory_max,
                                   struct flockmap_field **field);

// Frees a field. Null does nothing. No other thread may use it any more.
void flockmap_field_free(struct flockmap_field *field);

// Brings a field to a newer view of the same map; what did not change is not looked at. `did`: one of
// flockmap_update_kind; may be null. A view of another map makes nonsense: use flockmap_field_move_to. Any thread.
flockmap_result flockmap_field_update(struct flockmap_field *field,
                                      const struct flockmap_view *view,
                                      int32_t *did);

// Makes the field of another box or another map, in the memory of this one: for a box that goes with the robot. On
// FLOCKMAP_ERROR_TOO_LARGE it stays as it is. Any thread.
flockmap_result flockmap_field_move_to(struct flockmap_field *field,
                                       const struct flockmap_view *view,
                                       const struct flockmap_box *region);

// The box of a field. Any thread.
flockmap_result flockmap_field_box(const struct flockmap_field *field, struct flockmap_box *region);

// Distances at many points, trilinear between the centres of voxels. `points`: `count` times x, y, z, metres in the frame
// of the map. `distances_m`: room for `count`; infinity where the box has no obstacle, NaN outside of the box.
// `gradients`: room for `count` times x, y, z, metres of distance gained by a metre; null if not wanted. Any thread.
flockmap_result flockmap_field_at(const struct flockmap_field *field,
                                  const double *points,
                                  size_t count,
                                  double *distances_m,
                                  double *gradients);

// Whether the spheres of a radius about many points surely keep clear of every obstacle of the box, taken as full cubes;
// some that just pass are 0. `centres`: `count` times x, y, z. `clear`: room for `count`, 1 or 0; 0 outside of the box.
// FLOCKMAP_ERROR_ARGUMENT if the radius is negative or not finite. Any thread.
flockmap_result flockmap_field_are_clear(const struct flockmap_field *field,
                                         const double *centres,
                                         size_t count,
                                         double radius_m,
                                         uint8_t *clear);

// All distances in metres, at the centres of the voxels of the box: x fastest, then y, then z; infinity where the box has
// no obstacle. `distances_m`: room for `capacity`, which must be the number of voxels of the box, else it is
// FLOCKMAP_ERROR_ARGUMENT. Any thread.
flockmap_result flockmap_field_array(const struct flockmap_field *field,
                                     float *distances_m,
                                     size_t capacity);

// Writes a map by the ending of the path: .ply or .pcd with the centre of each voxel, or an OctoMap .bt. Equal maps give
// equal files; a file that is there is replaced.
//
// `path`: UTF-8, ends with a 0. `with_free` 1: .ply and .pcd hold free voxels too (a .bt always does). `*voxels`: how
// many were written; may be null. FLOCKMAP_ERROR_FILE says what was wrong with the file. Any thread.
flockmap_result flockmap_view_save(const struct flockmap_view *view,
                                   const char *path,
                                   int32_t with_free,
                                   uint64_t *voxels);

// Reads a map by the ending of the path: an OctoMap .bt, a .ply or .pcd that flockmap_view_save wrote, or a point cloud
// (.ply, .pcd, .las, .laz), of which every voxel with a point is Occupied.
//
// `resolution_m`: side of a voxel of a point cloud; a map has its own. `*view` is to be freed by flockmap_view_free; null
// on an error. FLOCKMAP_ERROR_FILE names the file, the place in it and what was wrong. Any thread.
flockmap_result flockmap_view_load(const char *path,
                                   double resolution_m,
                                   struct flockmap_view **view);

// The columns of a box as an occupancy grid.
//
// `rule`: one of flockmap_column_kind. `cells`: room for `capacity`, which must be size[0] * size[1] of the box, else it is
// FLOCKMAP_ERROR_ARGUMENT; row by row from the lowest y, x fastest; 0 free, 100 occupied, -1 unknown, as
// nav_msgs/OccupancyGrid has them. FLOCKMAP_ERROR_TOO_LARGE above 2^26 cells. Any thread.
flockmap_result flockmap_view_occupancy_grid(const struct flockmap_view *view,
                                             const struct flockmap_box *band,
                                             int32_t rule,
                                             int8_t *cells,
                                             size_t capacity);

// The lowest and the highest obstacle of each column of a box, in metres in the frame of the map.
//
// `bottoms_m`: the lower face of the lowest Occupied voxel; `tops_m`: the upper face of the highest; NaN where there is
// none. Either may be null. Room for `capacity` each, and order, as for flockmap_view_occupancy_grid.
// FLOCKMAP_ERROR_TOO_LARGE above 2^24 cells. Any thread.
flockmap_result flockmap_view_height_map(const struct flockmap_view *view,
                                         const struct flockmap_box *region,
                                         float *bottoms_m,
                                         float *tops_m,
                                         size_t capacity);

// Looks for the frontiers of a box. `reach_m`: one reaches no further than this from its first voxel (1.5 is usual).
// `voxels_min`: fewer are none (6 is usual). FLOCKMAP_ERROR_TOO_LARGE above 2^28 voxels. `*found` is to be freed by
// flockmap_frontiers_free; null on an error. The view is not kept. Any thread.
flockmap_result flockmap_frontiers_new(const struct flockmap_view *view,
                                       const struct flockmap_box *region,
                                       double reach_m,
                                       size_t voxels_min,
                                       struct flockmap_frontiers **found);

// Frees frontiers. Null does nothing. No other thread may use them any more.
void flockmap_frontiers_free(struct flockmap_frontiers *found);

// `*count`: how many were found. Any thread.
flockmap_result flockmap_frontiers_count(const struct flockmap_frontiers *found, size_t *count);

// One of them, by their order along z, y, x. FLOCKMAP_ERROR_ARGUMENT if there are not so many. Any thread.
flockmap_result flockmap_frontiers_get(const struct flockmap_frontiers *found,
                                       size_t at,
                                       struct flockmap_frontier *frontier);

// Its voxels, 3 numbers each. `voxels`, `capacity` and `count` as for flockmap_view_voxels. Any thread.
flockmap_result flockmap_frontiers_voxels(const struct flockmap_frontiers *found,
                                          size_t at,
                                          int32_t *voxels,
                                          size_t capacity,
                                          size_t *count);

// Writes the defaults. `options` is the caller's; null is FLOCKMAP_ERROR_NULL. Any thread.
flockmap_result flockmap_robot_options_default(struct flockmap_robot_options *options);

// A number for a run: of the seconds since 1970 and 32 random bits. Any thread.
uint64_t flockmap_epoch(uint32_t seconds_since_1970, uint32_t random);

// Makes a robot with an empty map.
//
// `options` is read and not kept. `now_us` is the time on the robot's clock, in microseconds from any beginning; time
// that goes back later stands still. `*robot` is the new robot, to be freed by flockmap_robot_free; null on an error.
// FLOCKMAP_ERROR_CONFIG names the option that cannot work; a null is FLOCKMAP_ERROR_NULL. Any thread.
flockmap_result flockmap_robot_new(const struct flockmap_robot_options *options,
                                   int64_t now_us,
                                   struct flockmap_robot **robot);

// Makes a robot from the text of a node's configuration: `crates/flockmap-node/robot.example.toml` has every option.
//
// The mapper has the threads that `[map] threads` says; where it does not, half of the cores, at most 4.
//
// Sections that are for a node (network, sensor, map_output, store, state, metrics, output) are checked and not used:
// sockets and files are the caller's. A swarm key is taken from the text or the file that it names, not from the
// environment. `toml` ends with a 0, is UTF-8 of at most 1 MiB, and not kept. `epoch`, `now_us` and `robot` as for
// flockmap_robot_new. FLOCKMAP_ERROR_CONFIG names the key and its line. Any thread.
flockmap_result flockmap_robot_new_from_toml(const char *toml,
                                             uint64_t epoch,
                                             int64_t now_us,
                                             struct flockmap_robot **robot);

// The text of the last error of the calling thread, in UTF-8, and "" if there was none. It says which function,
// what was wrong, and what to do. Never null. Owned by the library; valid until the next call of this thread that
// fails. Any thread.
const char *flockmap_last_error(void);

// The name of a result, such as "FLOCKMAP_ERROR_NULL", and "FLOCKMAP_UNKNOWN" for a number that is none. Static, never null. Any thread.
const char *flockmap_result_name(int32_t result);

// The version of the library, such as "0.1.0". Static, never null. Any thread. Before 1.0 a header fits the library
// of its own minor version only: compare it with FLOCKMAP_VERSION_MAJOR and FLOCKMAP_VERSION_MINOR where the two can
// come apart.
const char *flockmap_version(void);

// Frees a robot. Its views stay. Null does nothing. No other thread may use the robot any more.
void flockmap_robot_free(struct flockmap_robot *robot);

// Takes in a scan. It is mapped before this returns; datagrams of it come with the next flockmap_robot_handle_timeout
// that is due.
//
// `now_us`: the time on the robot's clock; `stamp_us`: when the scan was made, on the same clock, in microseconds. A
// stamp ahead of `now_us` counts as now. `points`: `point_count` times x, y, z in metres, in the frame of the sensor;
// points that are not finite are ignored and counted. `no_returns`: rays that came back with nothing, a point far out
// along each; null with 0 if there are none. At most 2^24 of both. `T_map_sensor`: 16 numbers, row by row, the pose
// of the sensor in the map. `report` may be null.
//
// Buffers are read and not kept. What is wrong (FLOCKMAP_ERROR_NULL, FLOCKMAP_ERROR_ARGUMENT for a pose that is none
// or beyond the grid, FLOCKMAP_ERROR_TOO_LARGE) changes nothing. Any thread.
flockmap_result flockmap_robot_insert_scan(struct flockmap_robot *robot,
                                           int64_t now_us,
                                           int64_t stamp_us,
                                           const float *points,
                                           size_t point_count,
                                           const float *no_returns,
                                           size_t no_return_count,
                                           const double *T_map_sensor,
                                           struct flockmap_scan_report *report);

// Says how a robot's frame lies in this one's: 16 numbers, row by row, which take a point in the frame of `origin` to
// this robot's. May change at any time. The map stays as it is until it has been made by the new one, a part with each
// call of flockmap_robot_handle_timeout, which is due until then. FLOCKMAP_ERROR_ARGUMENT if it is no pose; the one
// before is kept then. Any thread.
flockmap_result flockmap_robot_set_alignment(struct flockmap_robot *robot,
                                             uint16_t origin,
                                             const double *T_own_origin);

// Begins the next submap of this run: what is seen from now on moves with it. `*submap`: its number; null: not wanted.
// FLOCKMAP_ERROR_ARGUMENT after 4,096 submaps; the last one goes on then. Any thread.
flockmap_result flockmap_robot_begin_submap(struct flockmap_robot *robot,
                                            int64_t now_us,
                                            uint16_t *submap);

// Says how a submap of this run lies in the map now, as after a closed loop: what all robots know of it moves there, and
// nothing of it is sent again. 16 numbers, row by row: the correction of what was given as `T_map_sensor` while the
// submap was written. Rounded to a tenth of a millimetre. Comes into force as an alignment does.
// FLOCKMAP_ERROR_ARGUMENT if the submap has not begun, or it is no pose; the one before is kept then. Any thread.
flockmap_result flockmap_robot_set_submap_pose(struct flockmap_robot *robot,
                                               int64_t now_us,
                                               uint16_t submap,
                                               const double *T_map_submap);

// Says how far a robot's clock is ahead of this one's, in microseconds; used in place of what is measured.
// `is_measured` 1: measure again, `ahead_us` is not used; else 0. Comes into force as an alignment does. Any thread.
flockmap_result flockmap_robot_set_clock_offset(struct flockmap_robot *robot,
                                                uint16_t origin,
                                                int64_t ahead_us,
                                                int32_t is_measured);

// Leaves what a robot observed out of the fused map (`is_muted` 1), or takes it in again (0). Comes into force as an
// alignment does. Any thread.
flockmap_result flockmap_robot_set_muted(struct flockmap_robot *robot,
                                         uint16_t origin,
                                         int32_t is_muted);

// Says where a team-mate is, so that it is not taken for an obstacle: 3 numbers, metres in the frame of the own map;
// `seen_us` on the own clock. Positions of at most 1,024 robots are kept. FLOCKMAP_ERROR_ARGUMENT if it is no position;
// the one before is kept then. Any thread.
flockmap_result flockmap_robot_set_teammate(struct flockmap_robot *robot,
                                            uint16_t id,
                                            const double *position_m,
                                            int64_t seen_us);

// The fused map at this moment: what any robot has seen, in the own frame. O(1).
//
// `*view` stays as it is while the robot goes on, and outlives it; free it by flockmap_view_free; null on an error.
// While a view lives, what changes in the map is copied once, region by region, so do not keep many. Any thread.
flockmap_result flockmap_robot_view(const struct flockmap_robot *robot,
                                    struct flockmap_view **view);

// What of the other robots, and of the own published changes, has come in: one layer for each run of each robot, the
// own one among them. Robots whose layers have the same digests hold the same. O(voxels).
//
// `layers`: room for `capacity`. `*count`: how many there are; with a capacity of 0 that is all that is asked for,
// with too little room it is FLOCKMAP_ERROR_BUFFER. Any thread.
flockmap_result flockmap_robot_layers(const struct flockmap_robot *robot,
                                      struct flockmap_layer *layers,
                                      size_t capacity,
                                      size_t *count);

// Takes in the states of single voxels, such as the changed keys of an octree. All of them count as observed.
//
// Stamps as in flockmap_robot_insert_scan. `resolution_m` must be the robot's: states are not resampled. `sensor_m`:
// where the sensor was, 3 numbers in metres in the frame of the map; null if nobody knows, which costs more bytes on
// the radio. `voxels`: `count` times x, y, z, the index of a voxel: floor(position / resolution). `states`: as many of
// flockmap_voxel_state. At most 2^22. Of two for one voxel the later wins. `report` may be null. Buffers are not kept;
// an error changes nothing. Any thread.
flockmap_result flockmap_robot_insert_states(struct flockmap_robot *robot,
                                             int64_t now_us,
                                             int64_t stamp_us,
                                             double resolution_m,
                                             const double *sensor_m,
                                             const int32_t *voxels,
                                             const uint8_t *states,
                                             size_t count,
                                             struct flockmap_scan_report *report);

// Takes in all voxels of a box, such as the local map of another mapper. Only voxels whose state differs count as
// observed.
//
// As flockmap_robot_insert_states, but: `low`, 3 numbers: the index of the lowest voxel. `size`, 3 numbers: voxels
// along x, y, z, 1 or more. `states`: `state_count` of them, which must be size[0] * size[1] * size[2], x fastest,
// then y, then z. At most 2^25. `clear_unknown` 1: Unknown takes back what the robot itself knew; 0: it leaves it.
flockmap_result flockmap_robot_insert_box(struct flockmap_robot *robot,
                                          int64_t now_us,
                                          int64_t stamp_us,
                                          double resolution_m,
                                          const double *sensor_m,
                                          const int32_t *low,
                                          const uint32_t *size,
                                          const uint8_t *states,
                                          size_t state_count,
                                          int32_t clear_unknown,
                                          struct flockmap_scan_report *report);

// Takes in a datagram: what it brings is decoded, merged and fused before this returns.
//
// `bytes`: the `length` bytes of the UDP payload, read and not kept; any bytes will do no harm. FLOCKMAP_ERROR_DATAGRAM:
// damaged, foreign or forged; it is counted already, go on. Any thread.
flockmap_result flockmap_robot_handle_datagram(struct flockmap_robot *robot,
                                               int64_t now_us,
                                               const uint8_t *bytes,
                                               size_t length);

// The same for a caller that sends to addresses, which should be every one with UDP: `path` is a number of the
// caller's for the address that it came from (its place in a list). Nothing but a challenge goes to an address by
// unicast before an answer came back from there.
flockmap_result flockmap_robot_handle_datagram_from(struct flockmap_robot *robot,
                                                    int64_t now_us,
                                                    uint64_t path,
                                                    const uint8_t *bytes,
                                                    size_t length);

// Lets time pass: closes the batch that is due, asks for what was lost. Call it when flockmap_robot_poll_timeout has
// come; earlier does no harm. Any thread.
flockmap_result flockmap_robot_handle_timeout(struct flockmap_robot *robot,
                                              int64_t now_us);

// When to call flockmap_robot_handle_timeout at the latest, on the robot's clock: `*due_us`, which may lie in the past.
// FLOCKMAP_NONE: nothing is due before the next input. Ask again after every input. Any thread.
flockmap_result flockmap_robot_poll_timeout(const struct flockmap_robot *robot,
                                            int64_t *due_us);

// The next datagram to send. Call it after every input until it is FLOCKMAP_NONE.
//
// `bytes`: room for `capacity`, at least FLOCKMAP_DATAGRAM_BYTES_MAX, else it is FLOCKMAP_ERROR_BUFFER and nothing is
// taken. `*transmit`: its length, and where it goes. What cannot be sent is lost, and repaired as all that is lost.
// Any thread.
flockmap_result flockmap_robot_poll_transmit(struct flockmap_robot *robot,
                                             int64_t now_us,
                                             uint8_t *bytes,
                                             size_t capacity,
                                             struct flockmap_transmit *transmit);

// Closes the batch now, with whatever has changed: before the end of a run. Any thread.
flockmap_result flockmap_robot_flush(struct flockmap_robot *robot, int64_t now_us);

// `*voxels`: how many have changed and are still to be published. O(blocks with changes). Any thread.
flockmap_result flockmap_robot_unpublished(const struct flockmap_robot *robot, size_t *voxels);

// A map of which nothing is known, at version 0. `resolution_m`: side of a voxel, 0.001 to 100. `*view` is to be freed
// by flockmap_view_free; null on an error. Any thread.
flockmap_result flockmap_view_new(double resolution_m,
                                  struct flockmap_view **view);

// A view in which some blocks of another one are replaced, such as those that a mirror of a node's map received.
//
// `indices`: `count` times x, y, z, the index of a block: that of a voxel divided by 8, rounded down; within +-2^25.
// `free`, `occupied`: 8 words for each, as flockmap_view_block writes them. A voxel that is both is FLOCKMAP_ERROR_ARGUMENT.
// At most 2^22 blocks at a time. `view` stays as it is; `*changed` is a new one with a higher version, to be freed by
// flockmap_view_free; null on an error. Any thread.
flockmap_result flockmap_view_with_blocks(const struct flockmap_view *view,
                                          const int32_t *indices,
                                          const uint64_t *free,
                                          const uint64_t *occupied,
                                          size_t count,
                                          struct flockmap_view **changed);

// Frees a view. Null does nothing. No other thread may use it any more; the robot that it is of may be gone.
void flockmap_view_free(struct flockmap_view *view);

// Version, resolution and counts. O(blocks). `info` is the caller's. Any thread.
flockmap_result flockmap_view_info(const struct flockmap_view *view, struct flockmap_view_summary *info);

// The smallest box that holds all blocks of which something is known. FLOCKMAP_NONE if nothing is. Any thread.
flockmap_result flockmap_view_bounds(const struct flockmap_view *view,
                                     struct flockmap_box *bounds);

// The voxels between two corners: `low_m` and `high_m`, 3 numbers each, in metres in the frame of the map. FLOCKMAP_ERROR_ARGUMENT if a
// corner is not finite, not below the other on an axis, or out of the grid. Any thread.
flockmap_result flockmap_box_between(double resolution_m,
                                     const double *low_m,
                                     const double *high_m,
                                     struct flockmap_box *region);

// States at many points. `points`: `count` times x, y, z, metres in the frame of the map. `states`: room for `count` of
// flockmap_voxel_state; Unknown for points that are not finite or out of the grid. Points in a row that lie in one
// block cost one look-up. Any thread.
flockmap_result flockmap_view_states(const struct flockmap_view *view,
                                     const double *points,
                                     size_t count,
                                     uint8_t *states);

// States of many voxels. `voxels`: `count` times x, y, z, the index of a voxel; any numbers. `states`: room for `count`
// of flockmap_voxel_state. Any thread.
flockmap_result flockmap_view_voxel_states(const struct flockmap_view *view,
                                           const int32_t *voxels,
                                           size_t count,
                                           uint8_t *states);

// One block of 8 x 8 x 8 voxels. `index`: 3 numbers, that of a voxel divided by 8, rounded down. `free`, `occupied`: room
// for 8 words each: word z, bit 8 * y + x of the place (0 to 7) of a voxel in the block. FLOCKMAP_NONE if nothing of it
// is known. Any thread.
flockmap_result flockmap_view_block(const struct flockmap_view *view,
                                    const int32_t *index,
                                    uint64_t *free,
                                    uint64_t *occupied);

// The blocks that changed after a version, as 3 numbers each, and whatever else may have. FLOCKMAP_NONE: too many were
// emptied since to know; look at all of them. `indices`, `capacity`, `count` as for flockmap_view_voxels; version 0
// asks for all blocks. Any thread.
flockmap_result flockmap_view_changed_since(const struct flockmap_view *view,
                                            uint64_t version,
                                            int32_t *indices,
                                            size_t capacity,
                                            size_t *count);

// The voxels of a state: 3 numbers each, ascending by x, y, z. O(voxels known).
//
// `region`: only those of this box; null: of all of the map. `state`: FLOCKMAP_VOXEL_STATE_FREE or _OCCUPIED. `voxels`: room for
// `capacity` of them. `*count`: how many there are; with a capacity of 0 that is all that is asked for (`voxels` may be
// null), with too little room it is FLOCKMAP_ERROR_BUFFER and no voxel is written. A view does not change, so the count
// holds. Any thread.
flockmap_result flockmap_view_voxels(const struct flockmap_view *view,
                                     const struct flockmap_box *region,
                                     int32_t state,
                                     int32_t *voxels,
                                     size_t capacity,
                                     size_t *count);

// The centres of the voxels that are Occupied, in the same order: x, y, z in metres, in the frame of the map, as float.
// Arguments as for flockmap_view_voxels. Any thread.
flockmap_result flockmap_view_occupied_points(const struct flockmap_view *view,
                                              const struct flockmap_box *region,
                                              float *points,
                                              size_t capacity,
                                              size_t *count);

// Follows many rays to the first voxel that is Occupied, or Unknown unless `through_unknown` is 1.
//
// `from`, `to`: `count` times x, y, z, metres in the frame of the map. `hits`: room for `count`. A point that is not
// finite or out of the grid ends as Unknown at its start. FLOCKMAP_ERROR_TOO_LARGE, before any is cast, if one is longer than 2^20 voxels.
// Any thread.
flockmap_result flockmap_view_cast_rays(const struct flockmap_view *view,
                                        const double *from,
                                        const double *to,
                                        size_t count,
                                        int32_t through_unknown,
                                        struct flockmap_ray_hit *hits);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* FLOCKMAP_H */
