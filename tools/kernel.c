/* The grid task's verification rollouts in C, one thread: the yardstick of bench_verify.py. Same model (one period of delay, wheel
   saturation, exact arcs), same controller (controllers/grid.py), same disturbance (uniform in the weighted ball), same moving
   obstacles and same metric (s2r_runtime/tasks/grid_world.py). Scenarios come from outside. Without disturbance and turns it computes the
   same trajectories as the Python code to rounding. */

#include <math.h>
#include <stdint.h>

#define MAX_MOVERS 8
static const double PI = 3.14159265358979323846;

typedef struct {
    int64_t rollouts, steps, width, size, rows, movers, period;
    double cell, left, bottom, dt, robot_radius, touch, turn_probability;
    double wheel_speed, track, radius, weight_x, weight_y, weight_theta;
    double speed, turn, max_turn, aligned, lookahead, body, margin, wall, fade, keep, foresight, fear, wary;
    uint64_t seed;
} Setting;

typedef struct { uint64_t s[4]; } Random;

static uint64_t splitmix(uint64_t *state) {
    uint64_t z = (*state += 0x9e3779b97f4a7c15ULL);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return z ^ (z >> 31);
}

static double uniform(Random *r) { /* xoshiro256+ */
    uint64_t *s = r->s, result = s[0] + s[3], t = s[1] << 17;
    s[2] ^= s[0]; s[3] ^= s[1]; s[1] ^= s[2]; s[0] ^= s[3]; s[2] ^= t;
    s[3] = (s[3] << 45) | (s[3] >> 19);
    return (double)(result >> 11) * 0x1.0p-53;
}

static double clamp(double v, double low, double high) { return v < low ? low : v > high ? high : v; }
static double wrap(double a) { return a - 2.0 * PI * rint(a / (2.0 * PI)); }
static double square(double a) { return a * a; }

typedef struct {
    const uint8_t *blocked;
    const double *distance;
    int64_t cell[MAX_MOVERS], direction[MAX_MOVERS];
    int moves[MAX_MOVERS];
    double x[MAX_MOVERS], y[MAX_MOVERS], vx[MAX_MOVERS], vy[MAX_MOVERS];
} World;

static const double EAST_WEST[4] = {1.0, 0.0, -1.0, 0.0}, NORTH_SOUTH[4] = {0.0, 1.0, 0.0, -1.0};

static double centre_x(const Setting *g, int64_t at) { return g->left + g->cell * ((double)(at % g->width) - 0.5); }
static double centre_y(const Setting *g, int64_t at) { return g->bottom + g->cell * ((double)(at / g->width) - 0.5); }

static void place(const Setting *g, World *w, int m) {
    double v = w->moves[m] ? g->cell / ((double)g->period * g->dt) : 0.0;
    w->x[m] = centre_x(g, w->cell[m]);
    w->y[m] = centre_y(g, w->cell[m]);
    w->vx[m] = v * EAST_WEST[w->direction[m]];
    w->vy[m] = v * NORTH_SOUTH[w->direction[m]];
}

static void move(const Setting *g, World *w, int64_t step, Random *r) {
    const int64_t offset[4] = {1, g->width, -1, -g->width};
    for (int m = 0; m < g->movers; m++) {
        if (step % g->period) {
            w->x[m] += g->dt * w->vx[m];
            w->y[m] += g->dt * w->vy[m];
            continue;
        }
        if (w->moves[m]) w->cell[m] += offset[w->direction[m]];
        double u = uniform(r);
        int64_t wanted = (w->direction[m] + (u < g->turn_probability / 2.0 ? 1 : u < g->turn_probability ? 3 : 0)) % 4;
        int64_t back = (wanted + 2) % 4;
        int stopped = w->blocked[w->cell[m] + offset[wanted]];
        w->direction[m] = stopped ? back : wanted;
        w->moves[m] = !(stopped && w->blocked[w->cell[m] + offset[back]]);
        place(g, w, m);
    }
}

static void control(const Setting *p, const World *w, const double *x, double time_left, double *u) {
    double cell = p->cell, inset = p->body + p->wall;
    double column = floor(clamp((x[0] - p->left) / cell + 1.0, 1.0, (double)p->width - 1.5));
    double row = floor(clamp((x[1] - p->bottom) / cell + 1.0, 1.0, (double)p->rows + 0.5));
    int64_t at = (int64_t)row * p->width + (int64_t)column;
    double mid_x = p->left + cell * (column - 0.5), mid_y = p->bottom + cell * (row - 0.5);
    double off_x = x[0] - mid_x, off_y = x[1] - mid_y, ahead_s = fmin(p->foresight, time_left);
    double here = INFINITY, robot = INFINITY, near[4] = {INFINITY, INFINITY, INFINITY, INFINITY};
    for (int m = 0; m < p->movers; m++) {
        double nx = w->x[m] - mid_x, ny = w->y[m] - mid_y;
        double lx = nx + ahead_s * w->vx[m], ly = ny + ahead_s * w->vy[m];
        double hx = nx - 0.5 * off_x, hy = ny - 0.5 * off_y;
        double now = nx * nx + ny * ny, later = lx * lx + ly * ly, half = hx * hx + hy * hy;
        here = fmin(here, fmin(now, later));
        robot = fmin(robot, square(nx - off_x) + square(ny - off_y));
        for (int d = 0; d < 4; d++) {
            double n = nx * EAST_WEST[d] + ny * NORTH_SOUTH[d], l = lx * EAST_WEST[d] + ly * NORTH_SOUTH[d];
            double h = hx * EAST_WEST[d] + hy * NORTH_SOUTH[d];
            near[d] = fmin(near[d], now - 2.0 * cell * n + cell * cell);
            near[d] = fmin(near[d], later - 2.0 * cell * l + cell * cell);
            near[d] = fmin(near[d], now - cell * n + cell * cell / 4.0);
            near[d] = fmin(near[d], half - cell / 2.0 * h + cell * cell / 16.0);
        }
    }
    const int64_t offset[4] = {1, p->width, -1, -p->width};
    double best = w->distance[at] + p->fear * fmax(p->keep - sqrt(here), 0.0);
    int go = -1, wary = sqrt(robot) < p->wary;
    for (int d = 0; d < 4; d++) {
        double cost = w->distance[at + offset[d]] + p->fear * fmax(p->keep - sqrt(fmax(near[d], 0.0)), 0.0);
        if (cost < best) best = cost, go = d;
    }
    double to_x = -off_x, to_y = -off_y;
    if (go >= 0) {
        double gx = EAST_WEST[go], gy = NORTH_SOUTH[go], across = off_y * gx - off_x * gy;
        int64_t after = at + offset[go], left = offset[(go + 1) % 4];
        double on = INFINITY, to_left = INFINITY, to_right = INFINITY;
        if (after + offset[go] >= 0 && after + offset[go] < p->size) on = w->distance[after + offset[go]];
        if (after + left >= 0 && after + left < p->size) to_left = w->distance[after + left];
        if (after - left >= 0 && after - left < p->size) to_right = w->distance[after - left];
        double side = fmin(to_left, to_right) < fmin(w->distance[after], on) ? (to_left < to_right ? 1.0 : -1.0) : 0.0;
        double room = wary ? 0.0 : cell / 2.0 - p->body - p->margin;
        double line = side == 0.0 ? clamp(across, -room, room) : side * room;
        double outside = fabs(across) - room - (wary ? 0.07 : 0.0);
        double ahead = p->lookahead * clamp(1.0 - outside / (wary ? 0.07 : p->fade), 0.0, 1.0);
        to_x = ahead * gx - (line - across) * gy;
        to_y = ahead * gy + (line - across) * gx;
    }
    to_x = clamp(x[0] + to_x, p->left + inset, p->left + (double)(p->width - 2) * cell - inset) - x[0];
    to_y = clamp(x[1] + to_y, p->bottom + inset, p->bottom + (double)p->rows * cell - inset) - x[1];
    double error = wrap(atan2(to_y, to_x) - x[2]);
    double effort = go >= 0 ? 1.0 : fmin(sqrt(to_x * to_x + to_y * to_y) / 0.05, 1.0);
    u[0] = effort * p->speed * fmax((cos(error) - p->aligned) / (1.0 - p->aligned), 0.0);
    u[1] = effort * clamp(p->turn * error, -p->max_turn, p->max_turn);
}

static void drive(const Setting *g, double *x, const double *u, Random *r) {
    double half = g->track / 2.0;
    double left = clamp(u[0] - half * u[1], -g->wheel_speed, g->wheel_speed);
    double right = clamp(u[0] + half * u[1], -g->wheel_speed, g->wheel_speed);
    double travel = g->dt * (left + right) / 2.0, turned = g->dt * (right - left) / g->track, h = turned / 2.0;
    double chord = fabs(h) > 1e-12 ? sin(h) / h : 1.0;
    x[0] += travel * chord * cos(x[2] + h);
    x[1] += travel * chord * sin(x[2] + h);
    x[2] += turned;
    if (g->radius > 0.0) {
        double a, b, c;
        do {
            a = 2.0 * uniform(r) - 1.0;
            b = 2.0 * uniform(r) - 1.0;
            c = 2.0 * uniform(r) - 1.0;
        } while (a * a + b * b + c * c > 1.0);
        x[0] += g->radius / g->weight_x * a;
        x[1] += g->radius / g->weight_y * b;
        x[2] += g->radius / g->weight_theta * c;
    }
    x[2] = wrap(x[2]);
}

/* 1 crashed, 2 arrived, 0 neither; *at: the robot's cell */
static int look(const Setting *g, const World *w, const double *x, int64_t *at) {
    double column = floor(clamp((x[0] - g->left) / g->cell + 1.0, 0.5, (double)g->width - 0.5));
    double row = floor(clamp((x[1] - g->bottom) / g->cell + 1.0, 0.5, (double)g->rows + 1.5));
    *at = (int64_t)row * g->width + (int64_t)column;
    if (w->blocked[*at]) return 1;
    double fx = x[0] - (g->left + g->cell * (column - 0.5)), fy = x[1] - (g->bottom + g->cell * (row - 0.5));
    double edge_x = g->cell / 2.0 - fabs(fx), edge_y = g->cell / 2.0 - fabs(fy);
    int64_t sideways = fx > 0.0 ? 1 : -1, upward = fy > 0.0 ? g->width : -g->width;
    if (edge_x < g->robot_radius && w->blocked[*at + sideways]) return 1;
    if (edge_y < g->robot_radius && w->blocked[*at + upward]) return 1;
    if (square(edge_x) + square(edge_y) < square(g->robot_radius) && w->blocked[*at + sideways + upward]) return 1;
    for (int m = 0; m < g->movers; m++)
        if (square(w->x[m] - x[0]) + square(w->y[m] - x[1]) < square(g->touch)) return 1;
    return w->distance[*at] == 0.0 ? 2 : 0;
}

/* start (n, 3); blocked, distance (n, size); mover_cell, mover_direction, mover_moves (n, movers); safety (n), out */
void roll_out(const Setting *g, const double *start, const uint8_t *blocked, const double *distance, const int64_t *mover_cell,
              const int64_t *mover_direction, const uint8_t *mover_moves, double *safety) {
    uint64_t seed = g->seed;
    Random r;
    for (int i = 0; i < 4; i++) r.s[i] = splitmix(&seed);
    for (int64_t i = 0; i < g->rollouts; i++) {
        World w = {.blocked = blocked + i * g->size, .distance = distance + i * g->size};
        for (int m = 0; m < g->movers; m++) {
            w.cell[m] = mover_cell[i * g->movers + m];
            w.direction[m] = mover_direction[i * g->movers + m];
            w.moves[m] = mover_moves[i * g->movers + m];
            place(g, &w, m);
        }
        double x[3] = {start[3 * i], start[3 * i + 1], start[3 * i + 2]}, commanded[2] = {0.0, 0.0}, before[2];
        int64_t at;
        int outcome = look(g, &w, x, &at);
        double first = w.distance[at];
        /* to the horizon, like the batched code, which cannot stop for one rollout */
        for (int64_t k = 0; k < g->steps; k++) {
            before[0] = commanded[0], before[1] = commanded[1];
            control(g, &w, x, (double)(g->steps - k) * g->dt, commanded);
            drive(g, x, before, &r);
            move(g, &w, k + 1, &r);
            int64_t cell;
            int now = look(g, &w, x, &cell);
            if (!outcome) outcome = now, at = cell;
        }
        double left = w.distance[at];
        safety[i] = outcome == 1 ? -1.0 : fmax(rint((first - left) / g->cell) * g->cell, 0.0);
    }
}
