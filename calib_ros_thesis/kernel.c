/* Dense maps of a projected scan and their edges at its points: the inner loop of eq. 3.12 (thesis 3.4.3, figures 3.13 to 3.16).
 *
 * The same to the bit as maps.edge_maps, which calls OpenCV. maps.py calls it through ctypes.
 *
 * All stages go down the rows together, each as soon as the rows that it looks at are done, so that what it reads is still in the
 * cache. Rows are taken in chunks; where a map does not change, which is a third of it, its median and edges are not computed.
 */

#include <math.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MIN_DEPTH 0.5f /* m, as in point_score.py */
#define LINE 64        /* bytes of the cache that are read at once: vectors across their ends cost twice */
#define CHUNK 32       /* px */
#define PAD 32         /* px beside every row: what morphology reaches, at most */
#define BAND 8         /* rows that are filled or smoothed at once, even */
#define FAR 15         /* px; half sizes of the structuring elements of maps.py */
#define MIDDLE 3

#define INLINE static inline __attribute__((always_inline))
#if defined(__x86_64__) && defined(__linux__)
#define FOR_THIS_PROCESSOR __attribute__((target_clones("avx2", "default")))
#else
#define FOR_THIS_PROCESSOR
#endif
#define UNROLLED _Pragma("GCC unroll 32")
#define EACH(x, first, last) _Pragma("GCC ivdep") for (ptrdiff_t x = (first); x < (last); x++)

INLINE int16_t low(int16_t a, int16_t b) { return a < b ? a : b; }
INLINE int16_t high(int16_t a, int16_t b) { return a > b ? a : b; }
INLINE ptrdiff_t within(ptrdiff_t k, ptrdiff_t n) { return k < 0 ? 0 : k < n ? k : n - 1; }

/* A map of h rows of w px, and chunks to a whole number; lies in the workspace with PAD px on both sides of its rows. */
typedef struct {
    ptrdiff_t w, h, chunks, stride;
} Shape;

/* How edges of a map are found; has its mirror image in maps.py: change both together. */
typedef struct {
    int32_t inverse; /* levels are subtracted from it after completion, unless 0 */
    int32_t least;   /* lower levels become 0 */
    int32_t weak, strong; /* squares of Canny's thresholds */
    float full;      /* gradient of a full edge, at most 4096: its square is exact */
    int32_t sobel, canny; /* which of them count; both: their mean */
} Rule;

INLINE Shape shape_of(ptrdiff_t w, ptrdiff_t h)
{
    const ptrdiff_t chunks = (w + CHUNK - 1) / CHUNK;
    return (Shape){w, h, chunks, chunks * CHUNK + 2 * PAD};
}

/* Row y; above and below the map its first and last one. */
INLINE int16_t *row(const Shape *s, int16_t *map, ptrdiff_t y) { return map + within(y, s->h) * s->stride + PAD; }

/* Beside a row go on its first and last pixel: to a square around a pixel they are nothing new. */
INLINE void pad(const Shape *s, int16_t *line)
{
    for (int k = 1; k <= PAD; k++)
        line[-k] = line[0];
    EACH(x, s->w, s->w + PAD) line[x] = line[s->w - 1];
}

/* Dilation by the diamond and by the square of 5 px at once. */
INLINE void grow(const Shape *s, int16_t *sparse, int16_t *out, ptrdiff_t y, int16_t *scratch)
{
    int16_t *r[9], *v5 = scratch + PAD, *v7 = v5 + s->stride, *v9 = v7 + s->stride;
    for (int k = 0; k < 9; k++)
        r[k] = row(s, sparse, y + k - 4);
    EACH(x, -PAD, s->chunks * CHUNK + PAD)
    {
        const int16_t five = high(high(high(r[2][x], r[3][x]), high(r[4][x], r[5][x])), r[6][x]);
        const int16_t seven = high(five, high(r[1][x], r[7][x]));
        v5[x] = five;
        v7[x] = seven;
        v9[x] = high(seven, high(r[0][x], r[8][x]));
    }
    out = row(s, out, y);
    EACH(x, 0, s->chunks * CHUNK)
    {
        const int16_t wide = high(high(v5[x - 4], v5[x + 4]), high(v7[x - 3], v7[x + 3]));
        out[x] = high(high(high(high(v9[x - 2], v9[x - 1]), high(v9[x], v9[x + 1])), v9[x + 2]), wide);
    }
    pad(s, out);
}

/* Erosion by the square of 5 px. */
INLINE void shrink(const Shape *s, int16_t *grown, int16_t *out, ptrdiff_t y, int16_t *scratch)
{
    int16_t *r[5], *v = scratch + PAD;
    for (int k = 0; k < 5; k++)
        r[k] = row(s, grown, y + k - 2);
    EACH(x, -PAD, s->chunks * CHUNK + PAD) v[x] = low(low(low(r[0][x], r[1][x]), low(r[2][x], r[3][x])), r[4][x]);
    out = row(s, out, y);
    EACH(x, 0, s->chunks * CHUNK) out[x] = low(low(low(v[x - 2], v[x - 1]), low(v[x], v[x + 1])), v[x + 2]);
    pad(s, out);
}

INLINE int has_holes(const int16_t *chunk)
{
    int16_t any = 0;
    EACH(x, 0, CHUNK) any |= chunk[x] == 0;
    return any;
}

/* Filling of middle holes. holes: (chunks,) whether any are left. */
INLINE void fill_middle(const Shape *s, int16_t *closed, int16_t *out, ptrdiff_t y, uint8_t *holes, int16_t *scratch)
{
    int16_t *r[2 * MIDDLE + 1], *v = scratch + PAD;
    for (int k = 0; k <= 2 * MIDDLE; k++)
        r[k] = row(s, closed, y + k - MIDDLE);
    out = row(s, out, y);
    for (ptrdiff_t b = 0; b < s->chunks; b++)
        holes[b] = has_holes(r[MIDDLE] + b * CHUNK);
    for (ptrdiff_t b = 0, end; b < s->chunks; b = end) {
        for (end = b; end < s->chunks && holes[end];)
            end++;
        const ptrdiff_t first = b * CHUNK, last = end * CHUNK;
        if (end == b) {
            memcpy(out + first, r[MIDDLE] + first, CHUNK * sizeof *out);
            end++;
            continue;
        }
        EACH(x, first - 16, last + 16)
        v[x] = high(high(high(r[0][x], r[1][x]), high(r[2][x], r[3][x])), high(high(r[4][x], r[5][x]), r[6][x]));
        EACH(x, first, last)
        {
            const int16_t fill = high(high(high(v[x - 3], v[x - 2]), high(v[x - 1], v[x])), high(high(v[x + 1], v[x + 2]), v[x + 3]));
            out[x] = r[MIDDLE][x] ? r[MIDDLE][x] : fill;
        }
        for (ptrdiff_t k = b; k < end; k++)
            holes[k] = has_holes(out + k * CHUNK);
    }
    pad(s, out);
}

/* Every pixel becomes the larger of it and the one so many px on. */
INLINE void widen(int16_t *line, ptrdiff_t first, ptrdiff_t last, const int step)
{
    for (ptrdiff_t x = first; x < last; x++)
        line[x] = high(line[x], line[x + step]);
}

/* Filling of large holes in BAND rows from y on; low levels become 0. */
INLINE void fill_large(const Shape *s, int16_t *filled, int16_t *out, ptrdiff_t y, const uint8_t *holes, int least, int16_t *scratch)
{
    const ptrdiff_t rows = s->h - y < BAND ? s->h - y : BAND;
    int16_t *r[2 * FAR + BAND], *v[BAND];
    for (int k = 0; k < 2 * FAR + BAND; k++)
        r[k] = row(s, filled, y + k - FAR);
    for (int k = 0; k < BAND; k++)
        v[k] = scratch + k * s->stride + PAD;
    for (ptrdiff_t b = 0, end; b < s->chunks; b = end) {
        uint8_t any = 0;
        for (end = b; end < s->chunks; end++) {
            any = 0;
            for (ptrdiff_t k = 0; k < rows; k++)
                any |= holes[(y + k) * s->chunks + end];
            if (!any)
                break;
        }
        if (end == b) {
            for (ptrdiff_t k = 0; k < rows; k++) {
                int16_t *to = row(s, out, y + k), *from = r[k + FAR];
                EACH(x, b * CHUNK, (b + 1) * CHUNK) to[x] = from[x] > least ? from[x] : 0;
            }
            end++;
            continue;
        }
        const ptrdiff_t first = b * CHUNK, last = end * CHUNK;
        EACH(x, first - 16, last + 16)
        {
            /* What all rows of the band see, and from its two ends what some of them see. */
            int16_t all = r[BAND - 1][x], before[BAND], after[BAND];
            UNROLLED for (int k = BAND; k <= 2 * FAR; k++)
                all = high(all, r[k][x]);
            before[BAND - 1] = after[0] = all;
            UNROLLED for (int k = BAND - 2; k >= 0; k--)
                before[k] = high(before[k + 1], r[k][x]);
            UNROLLED for (int k = 1; k < BAND; k++)
                after[k] = high(after[k - 1], r[2 * FAR + k][x]);
            UNROLLED for (int k = 0; k < BAND; k++)
                v[k][x] = high(before[k], after[k]);
        }
        for (ptrdiff_t k = 0; k < rows; k++) {
            int16_t *line = v[k], *to = row(s, out, y + k), *from = r[k + FAR];
            widen(line, first - 16, last + 14, 1);
            widen(line, first - 16, last + 12, 2);
            widen(line, first - 16, last + 8, 4);
            widen(line, first - 16, last, 8);
            EACH(x, first, last)
            {
                const int16_t fill = high(line[x - FAR], line[x]), level = from[x] ? from[x] : fill;
                to[x] = level > least ? level : 0;
            }
        }
    }
    for (ptrdiff_t k = 0; k < rows; k++)
        pad(s, row(s, out, y + k));
}

INLINE void order(int16_t *a, int16_t *b)
{
    const int16_t lower = low(*a, *b), upper = high(*a, *b);
    *a = lower;
    *b = upper;
}

/* The network of nine comparisons that sorts five numbers. */
INLINE void sort(int16_t *a)
{
    static const uint8_t pairs[9][2] = {{0, 1}, {3, 4}, {2, 4}, {2, 3}, {1, 4}, {0, 3}, {0, 2}, {1, 3}, {1, 2}};
    UNROLLED for (int k = 0; k < 9; k++) order(a + pairs[k][0], a + pairs[k][1]);
}

typedef int16_t Five[5][CHUNK];
typedef int16_t Ten[10][CHUNK];

/* Of every pixel of a chunk the five of its row around it, sorted. */
INLINE void sort_row(const int16_t *line, Five out)
{
    EACH(x, 0, CHUNK)
    {
        int16_t a[5] = {line[x - 2], line[x - 1], line[x], line[x + 1], line[x + 2]};
        sort(a);
        UNROLLED for (int k = 0; k < 5; k++) out[k][x] = a[k];
    }
}

/* Those of two rows, merged by Batcher's network: odd with odd ones, even with even ones, then neighbours. */
INLINE void merge_rows(Five p, Five q, Ten out)
{
    static const uint8_t pairs[13][2] = {{0, 5}, {4, 9}, {5, 4}, {2, 7}, {2, 5}, {7, 4}, {1, 6}, {3, 8}, {6, 3}, {1, 2}, {6, 5}, {3, 7}, {8, 4}};
    static const uint8_t from[10] = {0, 1, 2, 6, 5, 3, 7, 8, 4, 9};
    EACH(x, 0, CHUNK)
    {
        int16_t a[10];
        UNROLLED for (int k = 0; k < 10; k++) a[k] = k < 5 ? p[k][x] : q[k - 5][x];
        UNROLLED for (int k = 0; k < 13; k++) order(a + pairs[k][0], a + pairs[k][1]);
        UNROLLED for (int k = 0; k < 10; k++) out[k][x] = a[from[k]];
    }
}

/* The medians of 5x5 px of a chunk in two rows, which share four rows of five pixels, p and q. Of these twenty only the six in the
 * middle may be a median, together with the five of the row above, or below. */
INLINE void medians(Ten p, Ten q, Five above, Five below, int inverse, int16_t *upper_row, int16_t *lower_row)
{
    EACH(x, 0, CHUNK)
    {
        int16_t l[10], h[10];
        for (int k = 0; k < 10; k++) {
            l[k] = low(p[k][x], q[9 - k][x]);
            h[k] = high(p[k][x], q[9 - k][x]);
        }
        for (int k = 0; k < 5; k++) {
            l[k] = high(l[k], l[k + 5]);
            h[k] = low(h[k], h[k + 5]);
        }
        sort(l);
        sort(h);
        int16_t up = h[2], down = h[2];
        const int16_t middle[5] = {l[2], l[3], l[4], h[0], h[1]};
        for (int k = 0; k < 5; k++) {
            up = low(up, high(middle[k], above[4 - k][x]));
            down = low(down, high(middle[k], below[4 - k][x]));
        }
        upper_row[x] = inverse && up ? inverse - up : up;
        lower_row[x] = inverse && down ? inverse - down : down;
    }
}

/* Whether a level of the chunk differs from the next one, or from the one below. */
INLINE uint8_t changes(const int16_t *line, const int16_t *below)
{
    int16_t any = 0;
    EACH(x, 0, CHUNK) any |= (line[x] ^ line[x + 1]) | (line[x] ^ below[x]);
    return any != 0;
}

/* Of every chunk, whether the map changes there or beside it in any of these rows; any: (chunks + 2,) scratch. */
INLINE void changed(const Shape *s, const uint8_t *change, ptrdiff_t first, ptrdiff_t last, uint8_t *any, uint8_t *active)
{
    memset(any, 0, s->chunks + 2);
    for (ptrdiff_t y = first < 0 ? 0 : first; y <= last && y < s->h; y++)
        EACH(b, 0, s->chunks) any[b + 1] |= change[y * s->chunks + b];
    EACH(b, 0, s->chunks) active[b] = any[b] | any[b + 1] | any[b + 2];
}

/* Median of BAND rows from y on. active: (h, chunks), of every second row where the map changes. */
INLINE void smooth(const Shape *s, int16_t *map, int16_t *out, ptrdiff_t y, const uint8_t *active, int inverse)
{
    Five sorted[8];
    Ten merged[2];
    for (ptrdiff_t b = 0; b < s->chunks; b++) {
        int ready = 0;
        for (ptrdiff_t top = y; top < y + BAND && top < s->h; top += 2) {
            int16_t spare[CHUNK], *upper = row(s, out, top) + b * CHUNK;
            int16_t *lower = top + 1 < s->h ? row(s, out, top + 1) + b * CHUNK : spare;
            if (!active[top * s->chunks + b]) {
                const int16_t *from = row(s, map, top) + b * CHUNK;
                EACH(x, 0, CHUNK) upper[x] = lower[x] = inverse && from[x] ? inverse - from[x] : from[x];
                ready = 0;
                continue;
            }
            for (ptrdiff_t k = ready ? top + 2 : top - 2; k <= top + 3; k++)
                sort_row(row(s, map, k) + b * CHUNK, sorted[k & 7]);
            if (!ready)
                merge_rows(sorted[(top - 1) & 7], sorted[top & 7], merged[(top / 2) & 1]);
            merge_rows(sorted[(top + 1) & 7], sorted[(top + 2) & 7], merged[(top / 2 + 1) & 1]);
            medians(merged[0], merged[1], sorted[(top - 2) & 7], sorted[(top + 3) & 7], inverse, upper, lower);
            ready = 1;
        }
    }
}

/* Parts of the workspace. */
typedef struct {
    int16_t *sparse, *a, *b, *c, *scratch;
    int32_t *strength, *stack;
    uint8_t *holes, *change, *active, *canny;
} Space;

INLINE Space parts(uint8_t *memory, const Shape *s)
{
    const ptrdiff_t n = (s->h + 3) * s->stride, flags = (s->h * s->chunks + 63) / 64 * 64;
    Space p;
    memory += -(uintptr_t)memory % LINE;
    p.strength = (int32_t *)memory + s->stride;
    p.stack = (int32_t *)memory + n;
    p.sparse = (int16_t *)(p.stack + n);
    p.a = p.sparse + n;
    p.b = p.a + n;
    p.c = p.b + n;
    p.scratch = p.c + n;
    p.canny = (uint8_t *)(p.scratch + BAND * s->stride);
    p.holes = p.canny + n;
    p.change = p.holes + flags;
    p.active = p.change + flags;
    return p;
}

/* Tells a caller whether it was made for another version of the struct. */
ptrdiff_t thesis_rule_size(void) { return (ptrdiff_t)sizeof(Rule); }

/* Bytes that the functions below need for maps of up to (h, w). */
ptrdiff_t thesis_space(ptrdiff_t w, ptrdiff_t h)
{
    const Shape s = shape_of(w, h);
    return (h + 3) * s.stride * 17 + BAND * s.stride * 2 + 3 * (h * s.chunks + 64) + LINE;
}

/* Density completion of the sparse map into p->a, and where it may have edges. */
INLINE void complete(const Shape *s, const Space *p, int inverse, int least)
{
    ptrdiff_t grown = 0, closed = 0, middle = 0, large = 0, known = 0, done = 0;
    const ptrdiff_t h = s->h;
    for (ptrdiff_t y = 0; y < h; y++)
        pad(s, row(s, p->sparse, y));
    while (done < h) {
        if (grown < h)
            grow(s, p->sparse, p->a, grown++, p->scratch);
        for (; closed < h && (grown == h || closed + 2 < grown); closed++)
            shrink(s, p->a, p->b, closed, p->scratch);
        for (; middle < h && (closed == h || middle + MIDDLE < closed); middle++)
            fill_middle(s, p->b, p->c, middle, p->holes + middle * s->chunks, p->scratch);
        for (; large < h && (middle == h || large + BAND + FAR <= middle); large += BAND)
            fill_large(s, p->c, p->b, large, p->holes, least, p->scratch);
        for (; known < h && (large >= h || known + 1 < large); known++)
            for (ptrdiff_t b = 0; b < s->chunks; b++)
                p->change[known * s->chunks + b] = changes(row(s, p->b, known) + b * CHUNK, row(s, p->b, known + 1) + b * CHUNK);
        for (; done < h && (known == h || done + BAND + 5 <= known); done += BAND) {
            for (ptrdiff_t y = done; y < done + BAND && y < h; y++)
                changed(s, p->change, (y & ~1) - 3, (y & ~1) + 3, (uint8_t *)p->scratch, p->active + y * s->chunks);
            smooth(s, p->b, p->a, done, p->active, inverse);
        }
    }
}

/* Gradients of eq. 3.9 of a row where the map changes, and their squared length, elsewhere 0; the border is mirrored. some: of
 * every pixel, whether it exceeds the weak threshold. */
INLINE void gradients(const Shape *s, const Space *p, ptrdiff_t y, const int32_t weak, int16_t *gx, int16_t *gy, uint8_t *some)
{
    const int16_t *b = row(s, p->a, y), *a = row(s, p->a, y > 0 ? y - 1 : 1), *c = row(s, p->a, y + 1 < s->h ? y + 1 : s->h - 2);
    int32_t *strength = p->strength + y * s->stride + PAD;
    const uint8_t *active = p->active + y * s->chunks;
    for (ptrdiff_t k = 0, end; k < s->chunks; k = end) {
        for (end = k + 1; end < s->chunks && active[end] == active[k];)
            end++;
        const ptrdiff_t first = k * CHUNK, last = end * CHUNK;
        if (active[k]) {
            EACH(x, first, last)
            {
                gx[x] = (int16_t)(a[x + 1] - a[x - 1] + 2 * (b[x + 1] - b[x - 1]) + c[x + 1] - c[x - 1]);
                gy[x] = (int16_t)(c[x - 1] - a[x - 1] + 2 * (c[x] - a[x]) + c[x + 1] - a[x + 1]);
                strength[x] = (int32_t)gx[x] * gx[x] + (int32_t)gy[x] * gy[x];
            }
            EACH(x, first, last) some[x] = strength[x] > weak;
        } else {
            EACH(x, first, last) strength[x] = 0;
            EACH(x, first, last) some[x] = 0;
        }
    }
    strength[-1] = 0;
    for (ptrdiff_t x = s->w; x < s->chunks * CHUNK + 1; x++)
        strength[x] = 0;
}

enum { NONE = 0, WEAK = 1, EDGE = 2 };

/* Non-maximum suppression of a row, as cv2.Canny does it by L2 norms: WEAK or EDGE into canny, and edges onto the stack. */
INLINE int32_t *suppress(const Shape *s, const Space *p, const Rule *rule, ptrdiff_t y, const int16_t *gx, const int16_t *gy,
                         const uint8_t *some, int32_t *stack)
{
    const int32_t weak = rule->weak, strong = rule->strong;
    for (ptrdiff_t first = 0; first < s->w; first += 8) {
        static const uint64_t none;
        if (!memcmp(some + first, &none, sizeof none))
            continue;
        const ptrdiff_t at = y * s->stride + PAD + first;
        const int32_t *own = p->strength + at, *up = own - s->stride, *down = own + s->stride;
        uint8_t *out = p->canny + at + s->stride;
        int32_t dx[8], dy[8], kind[8], any = 0;
        EACH(x, 0, 8) dx[x] = gx[first + x];
        EACH(x, 0, 8) dy[x] = gy[first + x];
        EACH(x, 0, 8)
        {
            const int32_t m = own[x], a = up[x - 1], b = up[x + 1], c = down[x - 1], d = down[x + 1];
            const int32_t left = own[x - 1], right = own[x + 1], above = up[x], below = down[x];
            /* Tangents of 22.5 and 67.5 degrees in integers, as there; halved, where the sum would exceed 32 bits. */
            const int32_t ax = dx[x] < 0 ? -dx[x] : dx[x], ay = dy[x] < 0 ? -dy[x] : dy[x];
            const int32_t flat = -((ay << 15) < ax * 13573), steep = -((ay << 14) > (ax * 13573 >> 1) + (ax << 15));
            const int32_t across = -((m > left) & (m >= right)), along = -((m > above) & (m >= below));
            const int32_t rising = -((dx[x] ^ dy[x]) < 0), slanted = (rising & -((m > b) & (m > c))) | (~rising & -((m > a) & (m > d)));
            const int32_t keep = (m > weak) & ((flat & across) | (~flat & ((steep & along) | (~steep & slanted))));
            kind[x] = keep + (keep & (m > strong));
            any |= kind[x];
        }
        for (int x = 0; x < 8; x++)
            out[x] = (uint8_t)kind[x];
        for (int x = 0; any & EDGE && x < 8; x++) {
            *stack = (int32_t)(out - p->canny) + x;
            stack += kind[x] == EDGE;
        }
    }
    return stack;
}

/* Gradients of the dense map in p->a, and its edges by Canny. */
INLINE void find_edges(const Shape *s, const Space *p, const Rule *rule)
{
    const int32_t stride = (int32_t)s->stride;
    int32_t *stack = p->stack;
    uint8_t *const canny = p->canny;
    int16_t *gx[2], *gy[2];
    uint8_t *some[2];
    for (int k = 0; k < 2; k++) {
        gx[k] = p->scratch + 3 * k * stride;
        gy[k] = gx[k] + stride;
        some[k] = (uint8_t *)(gy[k] + stride);
    }
    memset(p->strength - stride, 0, stride * sizeof *p->strength);
    memset(p->strength + s->h * stride, 0, stride * sizeof *p->strength);
    memset(canny, NONE, (s->h + 2) * stride);
    for (ptrdiff_t y = 0; y < s->h; y++) {
        int16_t *line = row(s, p->a, y);
        line[-1] = line[within(1, s->w)];
        line[s->w] = line[within(s->w - 2, s->w)];
    }
    for (ptrdiff_t y = 0; y <= s->h; y++) {
        const int now = y & 1, before = !now;
        if (y < s->h)
            gradients(s, p, y, rule->weak, gx[now], gy[now], some[now]);
        if (y > 0 && rule->canny)
            stack = suppress(s, p, rule, y - 1, gx[before], gy[before], some[before], stack);
    }
    while (stack != p->stack) {
        const int32_t from = *--stack;
        uint32_t above, beside, below, weak;
        memcpy(&above, canny + from - stride - 1, sizeof above);
        memcpy(&beside, canny + from - 1, sizeof beside);
        memcpy(&below, canny + from + stride - 1, sizeof below);
        memset(&weak, WEAK, sizeof weak);
        if (!((above | beside | below) & weak))
            continue;
        for (int32_t dy = -1; dy <= 1; dy++)
            for (int32_t dx = -1; dx <= 1; dx++) {
                const int32_t at = from + dy * stride + dx;
                if (canny[at] == WEAK) {
                    canny[at] = EDGE;
                    *stack++ = at;
                }
            }
    }
}

/* Adds the edges at points (n,), at these indices into maps, to total: algorithm 5. */
INLINE void add_edges(const Shape *s, const Space *p, const Rule *rule, const int32_t *at, ptrdiff_t n, float *total)
{
    const float full = rule->full, of_canny = rule->sobel ? 0.5f : 1, of_sobel = !rule->sobel ? 0 : rule->canny ? 0.5f : 1;
    for (ptrdiff_t first = 0; first < n; first += CHUNK) {
        const ptrdiff_t m = n - first < CHUNK ? n - first : CHUNK;
        float square[CHUNK] = {0}, thin[CHUNK] = {0};
        for (ptrdiff_t k = 0; k < m; k++) {
            square[k] = (float)p->strength[at[first + k]];
            thin[k] = p->canny[at[first + k] + s->stride] == EDGE;
        }
        EACH(k, 0, CHUNK)
        {
            const float gradient = sqrtf(square[k]) / full;
            square[k] = of_sobel * (gradient < 1 ? gradient : 1) + of_canny * thin[k];
        }
        for (ptrdiff_t k = 0; k < m; k++)
            total[first + k] += square[k];
    }
}

/* Points (3, n) times the intrinsics, far ones first -> columns, rows and indices of the nearest on each pixel of the image; returns
 * how many. last: (h, w) scratch. */
FOR_THIS_PROCESSOR
ptrdiff_t thesis_visible(const float *xyz, ptrdiff_t n, ptrdiff_t w, ptrdiff_t h, int32_t *last, int32_t *u, int32_t *v, int64_t *point)
{
    const float *px = xyz, *py = xyz + n, *pz = xyz + 2 * n, width = (float)w, height = (float)h;
    ptrdiff_t m = 0;
    EACH(k, 0, n)
    {
        const float column = rintf(px[k] / pz[k]), line = rintf(py[k] / pz[k]);
        const int inside = (pz[k] > MIN_DEPTH) & (column >= 0) & (column < width) & (line >= 0) & (line < height);
        u[k] = inside ? (int32_t)column : -1;
        v[k] = inside ? (int32_t)line : 0;
    }
    for (ptrdiff_t k = 0; k < n; k++)
        if (u[k] >= 0)
            last[v[k] * w + u[k]] = (int32_t)k;
    for (ptrdiff_t k = 0; k < n; k++)
        if (u[k] >= 0 && last[v[k] * w + u[k]] == k) {
            u[m] = u[k];
            v[m] = v[k];
            point[m++] = k;
        }
    return m;
}

/* The dense map (h, w) of a sparse one. */
FOR_THIS_PROCESSOR
void thesis_complete(uint8_t *memory, ptrdiff_t w, ptrdiff_t h, int32_t inverse, int32_t least, const int16_t *sparse, int16_t *out)
{
    const Shape s = shape_of(w, h);
    const Space p = parts(memory, &s);
    for (ptrdiff_t y = 0; y < h; y++)
        memcpy(row(&s, p.sparse, y), sparse + y * w, w * sizeof *sparse);
    complete(&s, &p, inverse, least);
    for (ptrdiff_t y = 0; y < h; y++)
        memcpy(out + y * w, row(&s, p.a, y), w * sizeof *out);
}

/* Where points at pixels (u, v) of the map lie in maps of the workspace. */
FOR_THIS_PROCESSOR
void thesis_places(ptrdiff_t w, const int32_t *u, const int32_t *v, ptrdiff_t n, int32_t left, int32_t top, int32_t *at)
{
    const Shape s = shape_of(w, 1);
    EACH(k, 0, n) at[k] = (v[k] - top) * (int32_t)s.stride + PAD + u[k] - left;
}

/* Adds to total (n,) the edges of the dense map at points, which have these levels. */
FOR_THIS_PROCESSOR
void thesis_level_edges(uint8_t *memory, ptrdiff_t w, ptrdiff_t h, const Rule *rule, const int16_t *levels, const int64_t *point,
                        const int32_t *at, ptrdiff_t n, float *total)
{
    const Shape s = shape_of(w, h);
    const Space p = parts(memory, &s);
    memset(p.sparse, 0, h * s.stride * sizeof *p.sparse);
    for (ptrdiff_t k = 0; k < n; k++) {
        const int16_t level = levels[point[k]];
        p.sparse[at[k]] = rule->inverse && level ? rule->inverse - level : level;
    }
    complete(&s, &p, rule->inverse, rule->least);
    find_edges(&s, &p, rule);
    add_edges(&s, &p, rule, at, n, total);
}

/* The same for a map (h, w) of objects, which is dense. */
FOR_THIS_PROCESSOR
void thesis_object_edges(uint8_t *memory, ptrdiff_t w, ptrdiff_t h, const Rule *rule, const uint8_t *map, const int32_t *at, ptrdiff_t n,
                         float *total)
{
    const Shape s = shape_of(w, h);
    const Space p = parts(memory, &s);
    for (ptrdiff_t y = 0; y < h; y++) {
        int16_t *line = row(&s, p.a, y);
        EACH(x, 0, w) line[x] = map[y * w + x];
        pad(&s, line);
    }
    for (ptrdiff_t y = 0; y < h; y++)
        for (ptrdiff_t b = 0; b < s.chunks; b++)
            p.change[y * s.chunks + b] = changes(row(&s, p.a, y) + b * CHUNK, row(&s, p.a, y + 1) + b * CHUNK);
    for (ptrdiff_t y = 0; y < h; y++)
        changed(&s, p.change, y - 1, y, (uint8_t *)p.scratch, p.active + y * s.chunks);
    find_edges(&s, &p, rule);
    add_edges(&s, &p, rule, at, n, total);
}
