/* Values of edge maps under projected points, and their derivatives by a left twist of the extrinsic.
 *
 * The same as the reference in test/support/numpy_sampler.py: float32, with sums in float64. It knows nothing of Python:
 * sampler.py calls it through ctypes, so that it needs a C compiler to be built and nothing else.
 *
 * Points are taken in blocks that stay in the first cache, and every step is a loop over a block that compilers turn into vector
 * instructions. Sums are kept in LANES partial sums whatever the vector length, so that every processor gets the same bits.
 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define MIN_DEPTH 0.5f /* m, as in sampler.py */
#define FAR 1e9f       /* m; depth given to points behind the camera */
#define OUTSIDE -9.0f  /* px; where they are put */
#define BEHIND -0.95f  /* cosine of the angle from the axis of a sphere beyond which no lens sees */
#define NO_RADIUS 1e-6f /* m; nearer to the axis an angle divided by it is noise */
#define BLOCK 256
#define LANES 8

#define INLINE static inline __attribute__((always_inline))
#if defined(__x86_64__) && defined(__linux__)
#define FOR_THIS_PROCESSOR __attribute__((target_clones("avx2", "default")))
#else
#define FOR_THIS_PROCESSOR
#endif

/* The partial sums. Arithmetic on them is that of each number on its own, whatever vector instructions there are. */
typedef float Lanes __attribute__((vector_size(LANES * sizeof(float)), aligned(4), may_alias));

/* Two neighbouring pixels in one word, and each of them. */
typedef int32_t Pair __attribute__((aligned(2), may_alias));
#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ == __ORDER_BIG_ENDIAN__
#define FIRST(pair) ((float)((pair) >> 16))
#define SECOND(pair) ((float)(int16_t)((pair) & 0xffff))
#else
#define FIRST(pair) ((float)(int16_t)((pair) & 0xffff))
#define SECOND(pair) ((float)((pair) >> 16))
#endif

/* One resolution of the maps and the points on them. Has its mirror image in sampler.py: change both together. */
typedef struct {
    const int16_t *image;            /* the tiles of all frames, each within a border of zeros */
    ptrdiff_t stride;                /* pixels from one row to the next; the image has less than 2^31 */
    const float *x, *y, *z, *weight; /* (count,) points in the LiDAR frame, and what they weigh */
    const float *left, *top;         /* (count,) px; corner of the tile that every point looks at */
    ptrdiff_t count;
    float fx, fy, cx, cy; /* intrinsics at this resolution */
    float width, height;  /* of a tile */
    float step;           /* px; half the distance over which the maps' slopes are taken */
    float unit;           /* of the image */
    int sphere;           /* the picture's radius is the angle from the axis, else a pinhole camera's */
} View;

typedef struct {
    float X[BLOCK], Y[BLOCK], Z[BLOCK]; /* in the camera frame */
    float depth[BLOCK];                 /* along the optical axis; of a sphere the distance */
    float stretch[BLOCK];               /* of a sphere: angle from the optical axis / distance from it, rad/m */
    float u[BLOCK], v[BLOCK];           /* px */
    const float *left, *top;            /* px; corner of the point's tile */
} Projected;

ptrdiff_t calib_view_size(void);
void calib_samples(const View *view, const double *transforms, ptrdiff_t n, float *out);
void calib_values(const View *view, const double *transforms, ptrdiff_t n, const int64_t *first, ptrdiff_t groups, double *out);
void calib_jacobian(const View *view, const double *transform, float *out);
void calib_linearise(const View *view, const double *transforms, ptrdiff_t n, double *gradients, double *scales);

/* The upper three rows of T_camera_lidar in float32. */
INLINE void rounded(const double *transform, float *T)
{
    for (int k = 0; k < 12; k++)
        T[k] = (float)transform[k];
}

INLINE int size_of_block(const View *view, ptrdiff_t first)
{
    const ptrdiff_t rest = view->count - first;
    return rest < BLOCK ? (int)rest : BLOCK;
}

/* Angle of (x, z) from the z axis towards x, by the polynomial of atanf in Moshier's Cephes library, without branches so that it
 * becomes vector instructions: atan2f of the C library takes longer than everything else here. Exact to 2e-7 rad. */
INLINE float angle_from_axis(float x, float z)
{
    const float a = fabsf(x), b = fabsf(z), low = a < b ? a : b, high = a < b ? b : a;
    float t = low / (high > 0 ? high : 1);
    const int steep = t > 0.4142135624f; /* tan(pi / 8) */
    t = steep ? (t - 1) / (t + 1) : t;
    const float q = t * t;
    float angle = t + t * q * (((8.05374449538e-2f * q - 1.38776856032e-1f) * q + 1.99777106478e-1f) * q - 3.33329491539e-1f);
    angle = steep ? angle + 0.7853981634f : angle;
    angle = a > b ? 1.5707963268f - angle : angle;
    angle = z < 0 ? 3.1415926536f - angle : angle;
    return x < 0 ? -angle : angle;
}

/* m points from `first` on. Those too near, behind the camera or not finite lie outside the picture. */
INLINE void project(const View *view, const float *T, ptrdiff_t first, int m, Projected *p)
{
    const float *x = view->x + first, *y = view->y + first, *z = view->z + first;
    p->left = view->left + first;
    p->top = view->top + first;
    for (int k = 0; k < m; k++) {
        p->X[k] = T[0] * x[k] + T[1] * y[k] + T[2] * z[k] + T[3];
        p->Y[k] = T[4] * x[k] + T[5] * y[k] + T[6] * z[k] + T[7];
        p->Z[k] = T[8] * x[k] + T[9] * y[k] + T[10] * z[k] + T[11];
    }
    if (view->sphere) {
        for (int k = 0; k < m; k++) {
            const float square = p->X[k] * p->X[k] + p->Y[k] * p->Y[k], r = sqrtf(square);
            const float distance = sqrtf(square + p->Z[k] * p->Z[k]);
            const int seen = (distance >= MIN_DEPTH) & (p->Z[k] >= BEHIND * distance);
            p->stretch[k] = r > NO_RADIUS ? angle_from_axis(r, p->Z[k]) / r : 1 / (distance >= MIN_DEPTH ? distance : FAR);
            p->depth[k] = seen ? distance : FAR;
            p->u[k] = seen ? p->X[k] * p->stretch[k] * view->fx + view->cx : OUTSIDE;
            p->v[k] = p->Y[k] * p->stretch[k] * view->fy + view->cy;
        }
        return;
    }
    for (int k = 0; k < m; k++) {
        const int seen = p->Z[k] >= MIN_DEPTH;
        p->depth[k] = seen ? p->Z[k] : FAR;
        p->u[k] = p->X[k] / p->depth[k];
        p->u[k] = seen ? p->u[k] * view->fx + view->cx : OUTSIDE;
        p->v[k] = p->Y[k] / p->depth[k] * view->fy + view->cy;
    }
}

/* The map under m pixels, moved by (du, dv), bilinear; 0 outside the tile. */
INLINE void sample(const View *view, int m, const Projected *p, float du, float dv, float *out)
{
    const int16_t *image = view->image, *below = image + view->stride;
    const int32_t stride = (int32_t)view->stride;
    int32_t at[BLOCK];
    float a[BLOCK], b[BLOCK];
    for (int k = 0; k < m; k++) {
        const float u = p->u[k] + du, v = p->v[k] + dv;
        const int inside = (u > -1.0f) & (u < view->width) & (v > -1.0f) & (v < view->height);
        const float column = (inside ? u : -1.0f) + p->left[k], row = (inside ? v : -1.0f) + p->top[k]; /* the border is 0 */
        const int32_t i = (int32_t)column, j = (int32_t)row; /* never negative: every tile has a border */
        a[k] = column - (float)i;
        b[k] = row - (float)j;
        at[k] = j * stride + i;
    }
    for (int k = 0; k < m; k++) {
        /* Two neighbours at once: looking up takes most of the time. */
        const int32_t above = *(const Pair *)(image + at[k]), under = *(const Pair *)(below + at[k]);
        const float upper = FIRST(above) * (1 - a[k]) + SECOND(above) * a[k];
        const float lower = FIRST(under) * (1 - a[k]) + SECOND(under) * a[k];
        out[k] = (upper * (1 - b[k]) + lower * b[k]) * view->unit;
    }
}

/* Derivatives (6, BLOCK) of m samples by a left twist; 0 for a point that is not well inside its tile. */
INLINE void slopes(const View *view, int m, const Projected *p, float J[6][BLOCK])
{
    const float h = view->step, across = view->fx / (2 * h), down = view->fy / (2 * h);
    float right[BLOCK], left[BLOCK], below[BLOCK], above[BLOCK];
    sample(view, m, p, h, 0, right);
    sample(view, m, p, -h, 0, left);
    sample(view, m, p, 0, h, below);
    sample(view, m, p, 0, -h, above);
    for (int k = 0; k < m; k++) {
        const float u = p->u[k], v = p->v[k], X = p->X[k], Y = p->Y[k], Z = p->Z[k];
        const int inside = (u >= 0) & (u <= view->width - 1) & (v >= 0) & (v <= view->height - 1);
        const float per_depth = inside ? 1 / p->depth[k] : 0;
        float jx = (right[k] - left[k]) * per_depth * across;
        float jy = (below[k] - above[k]) * per_depth * down;
        float jz;
        if (view->sphere) {
            /* jx and jy are divided by the distance: along the radius the picture moves by the angle, around the axis by
             * the angle over the distance from it. */
            const float r = sqrtf(X * X + Y * Y), x = r > NO_RADIUS ? X / r : 1, y = r > NO_RADIUS ? Y / r : 0;
            const float outward = jx * x + jy * y, sine = r * per_depth, cosine = Z * per_depth;
            const float around = inside ? (jy * x - jx * y) * p->depth[k] * p->stretch[k] : 0;
            jx = outward * cosine * x - around * y;
            jz = -outward * sine;
            jy = outward * cosine * y + around * x;
        } else {
            jz = -(jx * X + jy * Y) * per_depth;
        }
        J[0][k] = inside ? Y * jz - Z * jy : 0;
        J[1][k] = inside ? Z * jx - X * jz : 0;
        J[2][k] = inside ? X * jy - Y * jx : 0;
        J[3][k] = jx;
        J[4][k] = jy;
        J[5][k] = jz;
    }
}

/* Sum of the products of two blocks, of which the entries from m to a multiple of LANES are 0. */
INLINE double dot(const float *a, const float *b, int m)
{
    float lanes[LANES] = {0};
    for (int k = 0; k < m; k += LANES)
        for (int lane = 0; lane < LANES; lane++)
            lanes[lane] += a[k + lane] * b[k + lane];
    double sum = 0;
    for (int lane = 0; lane < LANES; lane++)
        sum += lanes[lane];
    return sum;
}

INLINE double sum_of(Lanes lanes)
{
    double sum = 0;
    for (int lane = 0; lane < LANES; lane++)
        sum += lanes[lane];
    return sum;
}

/* Adds to the gradient what m derivatives bring; the same bits as by add_row. */
INLINE void add_slopes(int m, const float *weight, float J[6][BLOCK], double *gradient)
{
    Lanes slope[6] = {{0}};
    for (int k = 0; k < m; k += LANES)
        for (int row = 0; row < 6; row++)
            slope[row] += *(const Lanes *)(weight + k) * *(const Lanes *)(J[row] + k);
    for (int row = 0; row < 6; row++)
        gradient[row] += sum_of(slope[row]);
}

/* Adds to the gradient and to the upper half of the scale what row `row` of m derivatives brings. All sums of a row at once: each
 * has to wait for its own last addition, and the others go on meanwhile. */
INLINE void add_row(int row, int m, const float *weight, float J[6][BLOCK], double *gradient, double *scale)
{
    Lanes slope = {0}, product[6] = {{0}};
    for (int k = 0; k < m; k += LANES) {
        const Lanes weighted = *(const Lanes *)(weight + k) * *(const Lanes *)(J[row] + k);
        slope += weighted;
        for (int column = row; column < 6; column++)
            product[column] += weighted * *(const Lanes *)(J[column] + k);
    }
    gradient[row] += sum_of(slope);
    for (int column = row; column < 6; column++)
        scale[6 * row + column] += sum_of(product[column]);
}

/* Weights of a block, and zeros up to a multiple of LANES. */
INLINE void weights_of(const View *view, ptrdiff_t first, int m, float *weight)
{
    memcpy(weight, view->weight + first, m * sizeof *weight);
    for (int k = m; k % LANES; k++)
        weight[k] = 0;
}

/* Tells a caller whether it was made for another version of the struct. */
ptrdiff_t calib_view_size(void)
{
    return (ptrdiff_t)sizeof(View);
}

/* Map values (n, count) at each of n transforms (n, 12). */
FOR_THIS_PROCESSOR
void calib_samples(const View *view, const double *transforms, ptrdiff_t n, float *out)
{
    float T[12];
    Projected p;
    for (ptrdiff_t j = 0; j < n; j++, out += view->count) {
        rounded(transforms + 12 * j, T);
        for (ptrdiff_t first = 0; first < view->count; first += BLOCK) {
            const int m = size_of_block(view, first);
            project(view, T, first, m, &p);
            sample(view, m, &p, 0, 0, out + first);
        }
    }
}

/* Points from `first` on, so many. */
INLINE View part_of(const View *view, ptrdiff_t first, ptrdiff_t count)
{
    View part = *view;
    part.x += first;
    part.y += first;
    part.z += first;
    part.weight += first;
    part.left += first;
    part.top += first;
    part.count = count;
    return part;
}

/* Their weighted sums (n, groups). A group begins at each of the points `first` (groups,): where these are the frames, one frame's
 * maps stay in the cache while all transforms are tried. */
FOR_THIS_PROCESSOR
void calib_values(const View *view, const double *transforms, ptrdiff_t n, const int64_t *first, ptrdiff_t groups, double *out)
{
    float T[12], weight[BLOCK], value[BLOCK];
    Projected p;
    for (ptrdiff_t group = 0; group < groups; group++) {
        const ptrdiff_t end = group + 1 < groups ? (ptrdiff_t)first[group + 1] : view->count;
        const View part = part_of(view, (ptrdiff_t)first[group], end - (ptrdiff_t)first[group]);
        for (ptrdiff_t j = 0; j < n; j++) {
            double sum = 0;
            rounded(transforms + 12 * j, T);
            for (ptrdiff_t from = 0; from < part.count; from += BLOCK) {
                const int m = size_of_block(&part, from);
                project(&part, T, from, m, &p);
                sample(&part, m, &p, 0, 0, value);
                weights_of(&part, from, m, weight);
                for (int k = m; k % LANES; k++)
                    value[k] = 0;
                sum += dot(weight, value, m);
            }
            out[j * groups + group] = sum;
        }
    }
}

/* Derivative (6, count) of every sample by a left twist at one transform (12,). */
FOR_THIS_PROCESSOR
void calib_jacobian(const View *view, const double *transform, float *out)
{
    float T[12], J[6][BLOCK];
    Projected p;
    rounded(transform, T);
    for (ptrdiff_t first = 0; first < view->count; first += BLOCK) {
        const int m = size_of_block(view, first);
        project(view, T, first, m, &p);
        slopes(view, m, &p, J);
        for (int row = 0; row < 6; row++)
            memcpy(out + row * view->count + first, J[row], m * sizeof **J);
    }
}

/* Gradients (n, 6) of the weighted sums, and the weighted outer products of the derivatives (n, 36); scales: NULL = not needed. */
FOR_THIS_PROCESSOR
void calib_linearise(const View *view, const double *transforms, ptrdiff_t n, double *gradients, double *scales)
{
    float T[12], J[6][BLOCK], weight[BLOCK];
    Projected p;
    for (ptrdiff_t j = 0; j < n; j++) {
        double *gradient = gradients + 6 * j, *scale = scales ? scales + 36 * j : NULL;
        memset(gradient, 0, 6 * sizeof *gradient);
        if (scale)
            memset(scale, 0, 36 * sizeof *scale);
        rounded(transforms + 12 * j, T);
        for (ptrdiff_t first = 0; first < view->count; first += BLOCK) {
            const int m = size_of_block(view, first);
            project(view, T, first, m, &p);
            slopes(view, m, &p, J);
            weights_of(view, first, m, weight);
            for (int row = 0; row < 6; row++)
                for (int k = m; k % LANES; k++)
                    J[row][k] = 0;
            if (!scale) {
                add_slopes(m, weight, J, gradient);
                continue;
            }
            add_row(0, m, weight, J, gradient, scale);
            add_row(1, m, weight, J, gradient, scale);
            add_row(2, m, weight, J, gradient, scale);
            add_row(3, m, weight, J, gradient, scale);
            add_row(4, m, weight, J, gradient, scale);
            add_row(5, m, weight, J, gradient, scale);
        }
        for (int row = 1; scale && row < 6; row++)
            for (int column = 0; column < row; column++)
                scale[6 * row + column] = scale[6 * column + row];
    }
}
