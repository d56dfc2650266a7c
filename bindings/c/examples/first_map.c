/* From nothing to a map, in C99: a scan, what the map knows of it, and what goes out to the others. */
#include <flockmap.h>
#include <stdio.h>

#define POINTS 21

static int failed(const char *what) {
    fprintf(stderr, "%s: %s\n", what, flockmap_last_error());
    return 1;
}

int main(void) {
    flockmap_robot_options options;
    flockmap_robot *robot = NULL;
    flockmap_view *view = NULL;
    flockmap_view_summary summary;
    flockmap_scan_report report;
    /* A wall 2 m ahead, 2 m wide; x, y, z of each point in the frame of the sensor. */
    float points[3 * POINTS];
    /* The sensor is 1 m above the origin of the map and looks along x. */
    const double T_map_sensor[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 1};
    const double asked[3 * 3] = {2.05, 0.0, 1.0, 1.0, 0.0, 1.0, 3.0, 0.0, 1.0};
    const char *names[] = {"unknown", "free", "occupied"};
    uint8_t states[3];
    uint8_t datagram[FLOCKMAP_DATAGRAM_BYTES_MAX];
    flockmap_transmit transmit;
    const int64_t now_us = 1000000, later_us = 2000000;
    int i, sent = 0;

    for (i = 0; i < POINTS; i++) {
        points[3 * i] = 2.05f;
        points[3 * i + 1] = -1.0f + 0.1f * (float)i;
        points[3 * i + 2] = 0.0f;
    }
    if (flockmap_robot_options_default(&options) != FLOCKMAP_OK) return failed("options");
    options.id = 7;
    if (flockmap_robot_new(&options, 0, &robot) != FLOCKMAP_OK) return failed("robot");
    if (flockmap_robot_insert_scan(robot, now_us, now_us, points, POINTS, NULL, 0, T_map_sensor, &report) != FLOCKMAP_OK)
        return failed("scan");
    if (flockmap_robot_view(robot, &view) != FLOCKMAP_OK) return failed("view");

    /* What goes out. Nobody is there to hear it, so it is not much. */
    if (flockmap_robot_handle_timeout(robot, later_us) != FLOCKMAP_OK) return failed("timeout");
    while (flockmap_robot_poll_transmit(robot, later_us, datagram, sizeof datagram, &transmit) == FLOCKMAP_OK) sent++;
    flockmap_robot_free(robot);

    /* The view is still there. */
    if (flockmap_view_info(view, &summary) != FLOCKMAP_OK) return failed("summary");
    if (flockmap_view_states(view, asked, 3, states) != FLOCKMAP_OK) return failed("states");
    printf("%zu hits made %zu voxels occupied and %zu free; %d datagrams\n", report.hits, summary.occupied, summary.free, sent);
    printf("the wall is %s, before it is %s, behind it %s\n", names[states[0]], names[states[1]], names[states[2]]);
    flockmap_view_free(view);
    return states[0] == FLOCKMAP_VOXEL_STATE_OCCUPIED && states[1] == FLOCKMAP_VOXEL_STATE_FREE &&
                   states[2] == FLOCKMAP_VOXEL_STATE_UNKNOWN && sent > 0
               ? 0
               : 1;
}
