// The inner loops of rasterize.cpp, which includes this file once per instruction set, each time in
// a namespace of its own under `#pragma GCC target`. (target_clones would not do: vector extensions
// are lowered for the default target before the clones are made.) Only raw pointers and built-ins
// here, so that no shared inline function is ever compiled for more than the oldest machine.
//
// Sixteen lanes are sixteen Gaussians when projecting and a block of 4 x 4 pixels when blending.

#define VDBC_INLINE static inline __attribute__((always_inline))
#define VDBC_MEMBER inline __attribute__((always_inline))

typedef float F4 __attribute__((vector_size(16), may_alias, aligned(4)));
typedef float F8 __attribute__((vector_size(32), may_alias));

#if VDBC_VECTOR_BITS == 512
typedef float F16 __attribute__((vector_size(64), may_alias));
typedef int32_t I16 __attribute__((vector_size(64), may_alias));

VDBC_INLINE F16 broadcast(float v) { return F16{v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v}; }
VDBC_INLINE F16 load(const float* from) { return *(const F16*)from; }
VDBC_INLINE void store(F16 v, float* to) { *(F16*)to = v; }
VDBC_INLINE F16 join(F8 lo, F8 hi) {
  return __builtin_shufflevector(lo, hi, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
}
VDBC_INLINE F16 select(I16 condition, F16 a, F16 b) { return condition ? a : b; }
VDBC_INLINE F16 smaller(F16 a, F16 b) { return a < b ? a : b; }
VDBC_INLINE F16 larger(F16 a, F16 b) { return a > b ? a : b; }
VDBC_INLINE F16 squareRoot(F16 x) { return (F16)_mm512_sqrt_ps((__m512)x); }
VDBC_INLINE I16 bitsOf(F16 x) { return (I16)x; }
VDBC_INLINE F16 fromBits(I16 x) { return (F16)x; }
VDBC_INLINE F16 toFloat(I16 x) { return __builtin_convertvector(x, F16); }
VDBC_INLINE I16 truncated(F16 x) { return __builtin_convertvector(x, I16); }
VDBC_INLINE bool anyAbove(F16 x, float limit) {
  return _mm512_cmp_ps_mask((__m512)x, _mm512_set1_ps(limit), _CMP_GT_OQ) != 0;
}
VDBC_INLINE F16 nearestInteger(F16 x) { return (F16)_mm512_roundscale_ps((__m512)x, 8); }
/// x 2^n for a whole n.
VDBC_INLINE F16 timesPowerOf2(F16 x, F16 n) { return (F16)_mm512_scalef_ps((__m512)x, (__m512)n); }

// Steps of a sum over lanes that transposes as it goes; see sumLanes.
VDBC_INLINE F16 addHalves(F16 a, F16 b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23) +
         __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30,
                                 31);
}
VDBC_INLINE F16 addQuarters(F16 a, F16 b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27) +
         __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30, 31);
}
VDBC_INLINE F16 addPairs(F16 a, F16 b) {
  return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
         __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
}
VDBC_INLINE F16 addNeighbours(F16 a, F16 b) {
  return __builtin_shufflevector(a, b, 0, 2, 16, 18, 4, 6, 20, 22, 8, 10, 24, 26, 12, 14, 28, 30) +
         __builtin_shufflevector(a, b, 1, 3, 17, 19, 5, 7, 21, 23, 9, 11, 25, 27, 13, 15, 29, 31);
}
#else
// Narrower registers: g++ would compare and select vectors that do not fit one element by element,
// so sixteen lanes are two vectors of eight or four of four.
constexpr int kWidth = VDBC_VECTOR_BITS / 32, kParts = kLanes / kWidth;
typedef float V __attribute__((vector_size(VDBC_VECTOR_BITS / 8), may_alias));
typedef int32_t VI __attribute__((vector_size(VDBC_VECTOR_BITS / 8), may_alias));
struct I16 {
  VI part[kParts];
  VDBC_MEMBER int operator[](int i) const { return part[i / kWidth][i % kWidth]; }
};
struct F16 {
  V part[kParts];
};
#define VDBC_PARTS(type, value)                           \
  type out;                                               \
  for (int p = 0; p < kParts; ++p) out.part[p] = (value); \
  return out;
VDBC_INLINE F16 broadcast(float v){VDBC_PARTS(F16, v - V{})}
#define VDBC_OPERATOR(op)                                                                     \
  VDBC_INLINE F16 operator op(F16 a,                                                          \
                              F16 b){VDBC_PARTS(F16, a.part[p] op b.part[p])} VDBC_INLINE F16 \
  operator op(F16 a, float b){VDBC_PARTS(F16, a.part[p] op b)} VDBC_INLINE F16                \
  operator op(float a, F16 b){VDBC_PARTS(F16, a op b.part[p])} VDBC_INLINE F16&               \
  operator op##=(F16& a, F16 b) {                                                             \
    return a = a op b;                                                                        \
  }                                                                                           \
  VDBC_INLINE F16& operator op##=(F16& a, float b) { return a = a op b; }
VDBC_OPERATOR(+) VDBC_OPERATOR(-) VDBC_OPERATOR(*) VDBC_OPERATOR(/)
#undef VDBC_OPERATOR
#define VDBC_OPERATOR(op)                                                                         \
  VDBC_INLINE I16 operator op(F16 a,                                                              \
                              F16 b){VDBC_PARTS(I16, VI(a.part[p] op b.part[p]))} VDBC_INLINE I16 \
  operator op(F16 a, float b) {                                                                   \
    return a op broadcast(b);                                                                     \
  }
    VDBC_OPERATOR(<) VDBC_OPERATOR(>) VDBC_OPERATOR(<=) VDBC_OPERATOR(>=) VDBC_OPERATOR(==)
#undef VDBC_OPERATOR
#define VDBC_OPERATOR(op)                                                                     \
  VDBC_INLINE I16 operator op(I16 a,                                                          \
                              I16 b){VDBC_PARTS(I16, a.part[p] op b.part[p])} VDBC_INLINE I16 \
  operator op(I16 a, int b) {                                                                 \
    VDBC_PARTS(I16, a.part[p] op b)                                                           \
  }
        VDBC_OPERATOR(&) VDBC_OPERATOR(|) VDBC_OPERATOR(+) VDBC_OPERATOR(-) VDBC_OPERATOR(<<)
            VDBC_OPERATOR(>>)
#undef VDBC_OPERATOR
                VDBC_INLINE I16&
                operator|=(I16& a, I16 b) {
  return a = a | b;
}
VDBC_INLINE F16 operator-(F16 a){VDBC_PARTS(F16, -a.part[p])} VDBC_INLINE F16
    load(const float* from){VDBC_PARTS(F16, ((const V*)from)[p])} VDBC_INLINE
    void store(F16 v, float* to) {
  for (int p = 0; p < kParts; ++p) ((V*)to)[p] = v.part[p];
}
VDBC_INLINE F16 join(F8 lo, F8 hi) {
  F16 out;
  __builtin_memcpy(&out, &lo, sizeof(F8));
  __builtin_memcpy((char*)&out + sizeof(F8), &hi, sizeof(F8));
  return out;
}
VDBC_INLINE F16 select(I16 condition, F16 a, F16 b){
    VDBC_PARTS(F16, condition.part[p] ? a.part[p] : b.part[p])} VDBC_INLINE F16
    smaller(F16 a, F16 b) {
  return select(a < b, a, b);
}
VDBC_INLINE F16 larger(F16 a, F16 b) { return select(a > b, a, b); }
VDBC_INLINE I16 bitsOf(F16 x){VDBC_PARTS(I16, (VI)x.part[p])} VDBC_INLINE F16
    fromBits(I16 x){VDBC_PARTS(F16, (V)x.part[p])} VDBC_INLINE I16
    truncated(F16 x){VDBC_PARTS(I16, __builtin_convertvector(x.part[p], VI))} VDBC_INLINE F16
    toFloat(I16 x){VDBC_PARTS(F16, __builtin_convertvector(x.part[p], V))} VDBC_INLINE
    bool anyAbove(F16 x, float limit) {
  const I16 above = x > limit;
  VI any = above.part[0];
  for (int p = 1; p < kParts; ++p) any |= above.part[p];
#if VDBC_VECTOR_BITS == 256
  return _mm256_movemask_ps((__m256)any) != 0;
#else
  return (any[0] | any[1] | any[2] | any[3]) != 0;
#endif
}
// The nearest integer ends up in the low bits of x + 1.5 * 2^23.
constexpr float kRounder = 12582912.f;
VDBC_INLINE F16 nearestInteger(F16 x) { return (x + kRounder) - kRounder; }
/// x 2^n for a whole n, both of moderate size.
VDBC_INLINE F16 timesPowerOf2(F16 x, F16 n) {
  return fromBits(bitsOf(x) + (bitsOf(n + kRounder) << 23));
}

// Steps of a sum over lanes that transposes as it goes; see sumLanes.
#if VDBC_VECTOR_BITS == 256
VDBC_INLINE F16 squareRoot(F16 x){
    VDBC_PARTS(F16, (V)_mm256_sqrt_ps((__m256)x.part[p]))} VDBC_INLINE F16 addHalves(F16 a, F16 b) {
  return {{a.part[0] + a.part[1], b.part[0] + b.part[1]}};
}
VDBC_INLINE V addQuarters(V a, V b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11) +
         __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
VDBC_INLINE F16 addQuarters(F16 a, F16 b) {
  return {{addQuarters(a.part[0], a.part[1]), addQuarters(b.part[0], b.part[1])}};
}
VDBC_INLINE V addPairs(V a, V b) {
  return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13) +
         __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
VDBC_INLINE V addNeighbours(V a, V b) {
  return __builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14) +
         __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}
#else
VDBC_INLINE F16 squareRoot(F16 x) {
  for (int i = 0; i < kLanes; ++i)
    x.part[i / kWidth][i % kWidth] = __builtin_sqrtf(x.part[i / kWidth][i % kWidth]);
  return x;
}
VDBC_INLINE F16 addHalves(F16 a, F16 b) {
  return {
      {a.part[0] + a.part[2], a.part[1] + a.part[3], b.part[0] + b.part[2], b.part[1] + b.part[3]}};
}
VDBC_INLINE F16 addQuarters(F16 a, F16 b) {
  return {
      {a.part[0] + a.part[1], a.part[2] + a.part[3], b.part[0] + b.part[1], b.part[2] + b.part[3]}};
}
VDBC_INLINE V addPairs(V a, V b) {
  return __builtin_shufflevector(a, b, 0, 1, 4, 5) + __builtin_shufflevector(a, b, 2, 3, 6, 7);
}
VDBC_INLINE V addNeighbours(V a, V b) {
  return __builtin_shufflevector(a, b, 0, 2, 4, 6) + __builtin_shufflevector(a, b, 1, 3, 5, 7);
}
#endif
VDBC_INLINE F16 addPairs(F16 a, F16 b){
    VDBC_PARTS(F16, addPairs(a.part[p], b.part[p]))} VDBC_INLINE F16 addNeighbours(F16 a, F16 b) {
  VDBC_PARTS(F16, addNeighbours(a.part[p], b.part[p]))
}
#undef VDBC_PARTS
#endif

/// Lane i takes base[stride * index[i]].
VDBC_INLINE F16 gather(const float* base, const int32_t* index, int stride) {
  float v[kLanes];
  for (int i = 0; i < kLanes; ++i) v[i] = base[int64_t(stride) * index[i]];
  return join(F8{v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7]},
              F8{v[8], v[9], v[10], v[11], v[12], v[13], v[14], v[15]});
}

VDBC_INLINE F8 rowsOf(const float* a, const float* b, bool four) {
  const F4 x = four ? *(const F4*)a : F4{a[0], a[1], a[2], 0.f};
  const F4 y = four ? *(const F4*)b : F4{b[0], b[1], b[2], 0.f};
  return __builtin_shufflevector(x, y, 0, 1, 2, 3, 4, 5, 6, 7);
}
/// Lane i of out[k] takes base[stride * index[i] + k], k < count; count is 3 or 0 modulo 4.
VDBC_INLINE void gatherRows(const float* base, const int32_t* index, int stride, int count,
                            F16* out) {
  for (int k = 0; k < count; k += 4) {
    const bool four = count - k >= 4;
    F8 column[2][4];
    for (int half = 0; half < 2; ++half) {
      F8 r[4];
      for (int i = 0; i < 4; ++i)
        r[i] = rowsOf(base + int64_t(stride) * index[8 * half + i] + k,
                      base + int64_t(stride) * index[8 * half + 4 + i] + k, four);
      const F8 xy01 = __builtin_shufflevector(r[0], r[1], 0, 8, 1, 9, 4, 12, 5, 13),
               zw01 = __builtin_shufflevector(r[0], r[1], 2, 10, 3, 11, 6, 14, 7, 15),
               xy23 = __builtin_shufflevector(r[2], r[3], 0, 8, 1, 9, 4, 12, 5, 13),
               zw23 = __builtin_shufflevector(r[2], r[3], 2, 10, 3, 11, 6, 14, 7, 15);
      column[half][0] = __builtin_shufflevector(xy01, xy23, 0, 1, 8, 9, 4, 5, 12, 13);
      column[half][1] = __builtin_shufflevector(xy01, xy23, 2, 3, 10, 11, 6, 7, 14, 15);
      column[half][2] = __builtin_shufflevector(zw01, zw23, 0, 1, 8, 9, 4, 5, 12, 13);
      column[half][3] = __builtin_shufflevector(zw01, zw23, 2, 3, 10, 11, 6, 7, 14, 15);
    }
    for (int j = 0; j < (four ? 4 : 3); ++j) out[k + j] = join(column[0][j], column[1][j]);
  }
}

/// rows[i][k] takes lane i of columns[k], k < 4.
VDBC_INLINE void transposeFour(const F16* columns, float (*rows)[4]) {
  alignas(64) float lane[4][kLanes];
  for (int k = 0; k < 4; ++k) store(columns[k], lane[k]);
  for (int first = 0; first < kLanes; first += 8) {
    const F8 x = *(const F8*)(lane[0] + first), y = *(const F8*)(lane[1] + first),
             z = *(const F8*)(lane[2] + first), w = *(const F8*)(lane[3] + first);
    const F8 xy01 = __builtin_shufflevector(x, y, 0, 8, 1, 9, 4, 12, 5, 13),
             zw01 = __builtin_shufflevector(z, w, 0, 8, 1, 9, 4, 12, 5, 13),
             xy23 = __builtin_shufflevector(x, y, 2, 10, 3, 11, 6, 14, 7, 15),
             zw23 = __builtin_shufflevector(z, w, 2, 10, 3, 11, 6, 14, 7, 15);
    const F8 r[4] = {__builtin_shufflevector(xy01, zw01, 0, 1, 8, 9, 4, 5, 12, 13),
                     __builtin_shufflevector(xy01, zw01, 2, 3, 10, 11, 6, 7, 14, 15),
                     __builtin_shufflevector(xy23, zw23, 0, 1, 8, 9, 4, 5, 12, 13),
                     __builtin_shufflevector(xy23, zw23, 2, 3, 10, 11, 6, 7, 14, 15)};
    for (int i = 0; i < 4; ++i) {
      *(F4*)rows[first + i] = __builtin_shufflevector(r[i], r[i], 0, 1, 2, 3);
      *(F4*)rows[first + 4 + i] = __builtin_shufflevector(r[i], r[i], 4, 5, 6, 7);
    }
  }
}

/// The sum over lanes of terms[t] goes to lane columnOfTerm(t).
constexpr int columnOfTerm(int t) { return t % 4 * 4 + t / 4; }
VDBC_INLINE F16 sumLanes(const F16* terms, int count) {
  F16 x[4], y[2];
  for (int g = 0; g < 4; ++g) {
    const F16 zero = {};
    const F16* t = terms + 4 * g;
    if (4 * g >= count) {
      x[g] = zero;
      continue;
    }
    const F16 first = addHalves(t[0], 4 * g + 1 < count ? t[1] : t[0]);
    x[g] = addQuarters(
        first, 4 * g + 2 < count ? addHalves(t[2], 4 * g + 3 < count ? t[3] : t[2]) : first);
  }
  y[0] = addPairs(x[0], x[1]);
  y[1] = count > 8 ? addPairs(x[2], count > 12 ? x[3] : x[2]) : F16{};
  return addNeighbours(y[0], y[1]);
}

VDBC_INLINE F16 clampTo(F16 x, F16 lo, F16 hi) { return smaller(larger(x, lo), hi); }

/// 2^x to 1e-7 relative for -126 <= x <= 127; some number, or NaN, elsewhere.
VDBC_INLINE F16 exp2Inside(F16 x) {
  const F16 n = nearestInteger(x), f = x - n;
  // Interpolates 2^f at the Chebyshev nodes of [-1/2, 1/2].
  F16 p = f * 0.00133908634f + 0.00967603192f;
  p = p * f + 0.0555035711f;
  p = p * f + 0.240221075f;
  p = p * f + 0.693147188f;
  p = p * f + 1.00000008f;
  return timesPowerOf2(p, n);
}
/// x below -126 counts as -126, above 127 as 127.
VDBC_INLINE F16 exp2Of(F16 x) {
  return exp2Inside(clampTo(x, broadcast(-126.f), broadcast(127.f)));
}

/// log2(x) to 1e-7 absolute for normal positive x.
VDBC_INLINE F16 log2Of(F16 x) {
  const I16 bits = bitsOf(x);
  const I16 exponent = (bits - 0x3f3504f3) >> 23;  // mantissa in [sqrt(1/2), sqrt(2))
  const F16 m = fromBits(bits - (exponent << 23));
  const F16 s = (m - 1.f) / (m + 1.f), s2 = s * s;
  F16 p = s2 * (1.f / 9) + (1.f / 7);
  p = p * s2 + (1.f / 5);
  p = p * s2 + (1.f / 3);
  p = p * s2 + 1.f;
  return toFloat(exponent) + s * p * 2.88539008f;  // 2 / ln 2
}

/// Indices s < n, ascending, whose bit is set in masks[s], which is readable up to n rounded up to
/// 16; `list` has room for kChunk + 16. Returns how many.
VDBC_INLINE int selectByBit(const uint16_t* masks, int n, int bit, uint16_t* list) {
  int count = 0;
#if VDBC_VECTOR_BITS == 512
  const __m512i wanted = _mm512_set1_epi32(1 << bit);
  __m512i index = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
  for (int s = 0; s < n; s += kLanes) {
    const __m512i mask = _mm512_cvtepu16_epi32(_mm256_loadu_si256((const __m256i*)(masks + s)));
    const __mmask16 valid = n - s < kLanes ? __mmask16((1u << (n - s)) - 1) : __mmask16(0xffff);
    const __mmask16 chosen = _mm512_mask_test_epi32_mask(valid, mask, wanted);
    _mm256_storeu_si256((__m256i*)(list + count),
                        _mm512_cvtepi32_epi16(_mm512_maskz_compress_epi32(chosen, index)));
    count += __builtin_popcount(chosen);
    index = _mm512_add_epi32(index, _mm512_set1_epi32(kLanes));
  }
#else
  for (int s = 0; s < n; ++s) {
    list[count] = uint16_t(s);
    count += (masks[s] >> bit) & 1;
  }
#endif
  return count;
}

// --- spherical harmonics
// ---------------------------------------------------------------------------

/// Basis of the 3DGS files at the unit vector (x, y, z); k = (degree + 1)^2 values.
VDBC_INLINE void shBasis(int degree, F16 x, F16 y, F16 z, F16* basis) {
  basis[0] = broadcast(0.28209479177387814f);
  if (degree < 1) return;
  basis[1] = y * -0.4886025119029199f;
  basis[2] = z * 0.4886025119029199f;
  basis[3] = x * -0.4886025119029199f;
  if (degree < 2) return;
  const F16 xx = x * x, yy = y * y, zz = z * z;
  basis[4] = x * y * 1.0925484305920792f;
  basis[5] = y * z * -1.0925484305920792f;
  basis[6] = (2.f * zz - xx - yy) * 0.31539156525252005f;
  basis[7] = x * z * -1.0925484305920792f;
  basis[8] = (xx - yy) * 0.5462742152960396f;
  if (degree < 3) return;
  basis[9] = y * (3.f * xx - yy) * -0.5900435899266435f;
  basis[10] = x * y * z * 2.890611442640554f;
  basis[11] = y * (4.f * zz - xx - yy) * -0.4570457994644658f;
  basis[12] = z * (2.f * zz - 3.f * xx - 3.f * yy) * 0.3731763325901154f;
  basis[13] = x * (4.f * zz - xx - yy) * -0.4570457994644658f;
  basis[14] = z * (xx - yy) * 1.445305721320277f;
  basis[15] = x * (xx - 3.f * yy) * -0.5900435899266435f;
}

/// Adds to d[3] the derivative of sum_k weight[k] basis[k] by (x, y, z), taken as free variables.
VDBC_INLINE void shBasisGradient(int degree, F16 x, F16 y, F16 z, const F16* weight, F16* d) {
  if (degree < 1) return;
  d[1] += weight[1] * -0.4886025119029199f;
  d[2] += weight[2] * 0.4886025119029199f;
  d[0] += weight[3] * -0.4886025119029199f;
  if (degree < 2) return;
  F16 w = weight[4] * 1.0925484305920792f;
  d[0] += w * y, d[1] += w * x;
  w = weight[5] * -1.0925484305920792f;
  d[1] += w * z, d[2] += w * y;
  w = weight[6] * 0.31539156525252005f;
  d[0] -= 2.f * w * x, d[1] -= 2.f * w * y, d[2] += 4.f * w * z;
  w = weight[7] * -1.0925484305920792f;
  d[0] += w * z, d[2] += w * x;
  w = weight[8] * 0.5462742152960396f;
  d[0] += 2.f * w * x, d[1] -= 2.f * w * y;
  if (degree < 3) return;
  const F16 xx = x * x, yy = y * y, zz = z * z;
  w = weight[9] * -0.5900435899266435f;
  d[0] += w * 6.f * x * y, d[1] += w * 3.f * (xx - yy);
  w = weight[10] * 2.890611442640554f;
  d[0] += w * y * z, d[1] += w * x * z, d[2] += w * x * y;
  w = weight[11] * -0.4570457994644658f;
  d[0] -= 2.f * w * x * y, d[1] += w * (4.f * zz - xx - 3.f * yy), d[2] += 8.f * w * y * z;
  w = weight[12] * 0.3731763325901154f;
  d[0] -= 6.f * w * x * z, d[1] -= 6.f * w * y * z, d[2] += w * (6.f * zz - 3.f * xx - 3.f * yy);
  w = weight[13] * -0.4570457994644658f;
  d[0] += w * (4.f * zz - 3.f * xx - yy), d[1] -= 2.f * w * x * y, d[2] += 8.f * w * x * z;
  w = weight[14] * 1.445305721320277f;
  d[0] += 2.f * w * x * z, d[1] -= 2.f * w * y * z, d[2] += w * (xx - yy);
  w = weight[15] * -0.5900435899266435f;
  d[0] += w * 3.f * (xx - yy), d[1] -= 6.f * w * x * y;
}

// --- projection
// ------------------------------------------------------------------------------------

/// Sixteen Gaussians on their way to the image. Shared by projection and its backward pass.
struct Projected {
  F16 from_eye[3];              // mean minus camera centre, world axes, metres
  F16 x, y, z, inv_z;           // camera axes, metres
  F16 xn, yn, xc, yc;           // x / z, y / z, and the same clamped for the Jacobian
  F16 quaternion[4], inv_norm;  // normalised; 1 / length before
  F16 rotation[9], scale[3];
  F16 jacobian_world[6];  // A = J W [2, 3]: world to pixels, linearised
  F16 b[6], c[6];         // B = A R, C = B diag(scale)
  F16 cov[3], inv_det;    // 2-D covariance xx, xy, yy with the low-pass, pixels^2
  F16 normal[3], det;     // C's row 0 x row 1; |normal|^2: the determinant without the low-pass
  F16 opacity;            // before the compensation
  F16 compensation;       // what the low-pass leaves of the opacity: 1 unless antialiasing
  F16 finite;             // 0, or NaN where log_scale is not finite or opacity_logit is NaN
  F16 colour[3];          // before the clamp at 0
  F16 basis[16], direction[3], inv_distance;
  F16 sh[48];
};

VDBC_INLINE void toCamera(const RasterView& v, const F16* from_eye, F16* x, F16* y, F16* z) {
  const float* r = v.camera_from_world;
  *x = r[0] * from_eye[0] + r[1] * from_eye[1] + r[2] * from_eye[2];
  *y = r[3] * from_eye[0] + r[4] * from_eye[1] + r[5] * from_eye[2];
  *z = r[6] * from_eye[0] + r[7] * from_eye[1] + r[8] * from_eye[2];
}

VDBC_INLINE void cross(const F16* a, const F16* b, F16* out) {
  for (int j = 0; j < 3; ++j) {
    const int k = (j + 1) % 3, l = (j + 2) % 3;
    out[j] = a[k] * b[l] - a[l] * b[k];
  }
}

VDBC_INLINE void projectBatch(const GaussianArrays& g, const RasterView& v, const int32_t* index,
                              Projected* out) {
  Projected& p = *out;
  gatherRows(g.mean, index, 3, 3, p.from_eye);
  for (int j = 0; j < 3; ++j) p.from_eye[j] = (p.from_eye[j] - v.eye[j]) - v.eye_rest[j];
  toCamera(v, p.from_eye, &p.x, &p.y, &p.z);
  p.inv_z = 1.f / p.z;
  p.xn = p.x * p.inv_z, p.yn = p.y * p.inv_z;
  p.xc = clampTo(p.xn, broadcast(v.x_min), broadcast(v.x_max));
  p.yc = clampTo(p.yn, broadcast(v.y_min), broadcast(v.y_max));

  F16 q[4], log_scale[3];
  gatherRows(g.rotation, index, 4, 4, q);
  gatherRows(g.log_scale, index, 3, 3, log_scale);
  p.inv_norm = 1.f / squareRoot(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
  for (int j = 0; j < 4; ++j) p.quaternion[j] = q[j] * p.inv_norm;
  const F16 qw = p.quaternion[0], qx = p.quaternion[1], qy = p.quaternion[2], qz = p.quaternion[3];
  p.rotation[0] = 1.f - 2.f * (qy * qy + qz * qz);
  p.rotation[1] = 2.f * (qx * qy - qw * qz);
  p.rotation[2] = 2.f * (qx * qz + qw * qy);
  p.rotation[3] = 2.f * (qx * qy + qw * qz);
  p.rotation[4] = 1.f - 2.f * (qx * qx + qz * qz);
  p.rotation[5] = 2.f * (qy * qz - qw * qx);
  p.rotation[6] = 2.f * (qx * qz - qw * qy);
  p.rotation[7] = 2.f * (qy * qz + qw * qx);
  p.rotation[8] = 1.f - 2.f * (qx * qx + qy * qy);
  p.finite = F16{};
  for (int j = 0; j < 3; ++j) {
    p.scale[j] = exp2Of(log_scale[j] * kLog2E);
    p.finite += log_scale[j] * 0.f;
  }

  const float* w = v.camera_from_world;
  const F16 jx = v.fx * p.inv_z, jy = v.fy * p.inv_z;
  for (int j = 0; j < 3; ++j) {
    p.jacobian_world[j] = jx * (w[j] - p.xc * w[6 + j]);
    p.jacobian_world[3 + j] = jy * (w[3 + j] - p.yc * w[6 + j]);
  }
  for (int r = 0; r < 2; ++r) {
    const F16* a = p.jacobian_world + 3 * r;
    for (int k = 0; k < 3; ++k) {
      p.b[3 * r + k] = a[0] * p.rotation[k] + a[1] * p.rotation[3 + k] + a[2] * p.rotation[6 + k];
      p.c[3 * r + k] = p.b[3 * r + k] * p.scale[k];
    }
  }
  const F16* c0 = p.c;
  const F16* c1 = p.c + 3;
  const F16 xx = c0[0] * c0[0] + c0[1] * c0[1] + c0[2] * c0[2];
  const F16 yy = c1[0] * c1[0] + c1[1] * c1[1] + c1[2] * c1[2];
  p.cov[0] = xx + v.low_pass;
  p.cov[1] = c0[0] * c1[0] + c0[1] * c1[1] + c0[2] * c1[2];
  p.cov[2] = yy + v.low_pass;
  // det(C Ct + l I) = |c0 x c1|^2 + l (xx + yy) + l^2: no cancellation for needles.
  cross(c0, c1, p.normal);
  p.det = p.normal[0] * p.normal[0] + p.normal[1] * p.normal[1] + p.normal[2] * p.normal[2];
  p.inv_det = 1.f / (p.det + v.low_pass * (xx + yy) + v.low_pass * v.low_pass);
  p.compensation = v.antialias ? squareRoot(p.det * p.inv_det) : broadcast(1.f);
  const F16 logit = gather(g.opacity_logit, index, 1);
  p.opacity = 1.f / (1.f + exp2Of(logit * -kLog2E));
  p.finite += select(logit == logit, F16{}, logit);

  for (int j = 0; j < 3; ++j) p.direction[j] = F16{};
  if (g.sh_degree > 0) {
    p.inv_distance =
        1.f / squareRoot(p.from_eye[0] * p.from_eye[0] + p.from_eye[1] * p.from_eye[1] +
                         p.from_eye[2] * p.from_eye[2]);
    for (int j = 0; j < 3; ++j) p.direction[j] = p.from_eye[j] * p.inv_distance;
  }
  shBasis(g.sh_degree, p.direction[0], p.direction[1], p.direction[2], p.basis);
  const int coefficients = (g.sh_degree + 1) * (g.sh_degree + 1);
  for (int j = 0; j < 3; ++j) p.colour[j] = broadcast(0.5f);
  gatherRows(g.sh, index, 3 * coefficients, 3 * coefficients, p.sh);
  for (int k = 0; k < coefficients; ++k)
    for (int j = 0; j < 3; ++j) p.colour[j] += p.basis[k] * p.sh[3 * k + j];
}

VDBC_INLINE bool finiteExtra(const GaussianArrays& g, int32_t i) {
  float sum = 0.f;
  for (int c = 0; c < g.extra_count; ++c) sum += g.extra[int64_t(g.extra_count) * i + c] * 0.f;
  return sum == 0.f;
}

/// Projects Gaussians [begin, end); those that can touch the image go to splats, boxes, depths and
/// index, which have room for end - begin. Returns how many.
static int projectRange(const GaussianArrays& g, const RasterView& v, int64_t begin, int64_t end,
                        Splat* splats, TileBox* boxes, float* depths, int32_t* index) {
  // 1. A generous cull: no rotation, no opacity.
  int kept = 0;
  const float widest = 2.f * kLn2 * -v.log2_min_alpha;
  const float slope_x = 1.f + v.x_max * v.x_max + v.x_min * v.x_min;
  const float slope_y = 1.f + v.y_max * v.y_max + v.y_min * v.y_min;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? int(end - first) : kLanes;
    alignas(64) int32_t batch[kLanes];
    for (int i = 0; i < kLanes; ++i) batch[i] = int32_t(first) + (i < lanes ? i : lanes - 1);
    F16 d[3], x, y, z, log_scale[3];
    gatherRows(g.mean, batch, 3, 3, d);
    for (int j = 0; j < 3; ++j) d[j] = (d[j] - v.eye[j]) - v.eye_rest[j];
    toCamera(v, d, &x, &y, &z);
    gatherRows(g.log_scale, batch, 3, 3, log_scale);
    const F16 widest_scale = larger(larger(log_scale[0], log_scale[1]), log_scale[2]);
    const F16 scale = exp2Of(smaller(widest_scale, broadcast(40.f)) * kLog2E);
    const F16 inv_z = 1.f / z;
    const F16 variance = scale * inv_z * scale * inv_z;
    const F16 rx = squareRoot(widest * (v.fx * v.fx * slope_x * variance + v.low_pass)) + 1.f;
    const F16 ry = squareRoot(widest * (v.fy * v.fy * slope_y * variance + v.low_pass)) + 1.f;
    const F16 px = v.fx * x * inv_z + v.cx, py = v.fy * y * inv_z + v.cy;
    // NaN fails every comparison. What is in front and reaches the image stays.
    const I16 keep = (z > v.near_m) & (z < 1e18f) & (px + rx > 0.f) & (px - rx < float(v.width)) &
                     (py + ry > 0.f) & (py - ry < float(v.height));
    for (int i = 0; i < lanes; ++i) {
      index[kept] = int32_t(first) + i;
      kept -= keep[i];
    }
  }

  // 2. The rest in full.
  int count = 0;
  uint32_t instances = 0;
  for (int first = 0; first < kept; first += kLanes) {
    const int lanes = kept - first < kLanes ? kept - first : kLanes;
    alignas(64) int32_t batch[kLanes];
    for (int i = 0; i < kLanes; ++i) batch[i] = index[first + (i < lanes ? i : lanes - 1)];
    Projected p;
    projectBatch(g, v, batch, &p);
    const F16 px = v.fx * p.xn + v.cx, py = v.fy * p.yn + v.cy;
    const F16 conic_a = p.cov[2] * p.inv_det, conic_b = -p.cov[1] * p.inv_det,
              conic_c = p.cov[0] * p.inv_det;
    const F16 log2_opacity = log2Of(larger(p.opacity * p.compensation, broadcast(1e-30f)));
    const F16 cut = log2_opacity - v.log2_min_alpha;
    // Radii of the level set alpha = min_alpha, a little generous: the test of alpha decides.
    const F16 reach = larger(cut, broadcast(0.f)) * (2.f * kLn2 * 1.0002f);
    const F16 rx = squareRoot(reach * p.cov[0]) + 0.002f;
    const F16 ry = squareRoot(reach * p.cov[2]) + 0.002f;
    const F16 sum = px + py + conic_a + conic_b + conic_c + p.opacity + p.colour[0] + p.colour[1] +
                    p.colour[2] + rx + ry + p.inv_norm + p.compensation + p.finite;
    // 0 * finite is 0, 0 * (infinity or NaN) is NaN.
    const I16 keep = (sum * 0.f == 0.f) & (cut >= 0.f) & (p.inv_det > 0.f) & (p.inv_norm > 0.f);
    const F16 zero = broadcast(0.f);
    // First and last pixel whose centre is inside; + 2 and - 1 turn truncation into floor.
    const F16 least = zero - 1.f, x_end = broadcast(float(v.width)),
              y_end = broadcast(float(v.height));
    const I16 x_lo = truncated(clampTo(px - rx - 0.5f, least, x_end) + 2.f) - 1,
              x_hi = truncated(clampTo(px + rx - 0.5f, least, x_end - 1.f) + 2.f) - 2,
              y_lo = truncated(clampTo(py - ry - 0.5f, least, y_end) + 2.f) - 1,
              y_hi = truncated(clampTo(py + ry - 0.5f, least, y_end - 1.f) + 2.f) - 2;
    const F16 touches = select(keep & (toFloat(x_hi - x_lo) >= 0.f) & (toFloat(y_hi - y_lo) >= 0.f),
                               broadcast(1.f), zero);
    constexpr int kTileShift = 4;
    static_assert(1 << kTileShift == kTile, "shift");
    // The members of Splat in order.
    const F16 members[12] = {px,
                             py,
                             conic_a * (0.5f * kLog2E),
                             conic_b * kLog2E,
                             conic_c * (0.5f * kLog2E),
                             log2_opacity,
                             p.z,
                             larger(p.colour[0], zero),
                             larger(p.colour[1], zero),
                             larger(p.colour[2], zero),
                             zero,
                             zero};
    alignas(64) float rows[3][kLanes][4], touching[kLanes];
    alignas(64) int32_t tile[4][kLanes];
    for (int k = 0; k < 3; ++k) transposeFour(members + 4 * k, rows[k]);
    store(touches, touching);
    store(fromBits(x_lo >> kTileShift), (float*)tile[0]);
    store(fromBits(y_lo >> kTileShift), (float*)tile[1]);
    store(fromBits(x_hi >> kTileShift), (float*)tile[2]);
    store(fromBits(y_hi >> kTileShift), (float*)tile[3]);
    for (int i = 0; i < lanes; ++i) {
      if (touching[i] == 0.f || !finiteExtra(g, batch[i])) continue;
      const TileBox box = {uint16_t(tile[0][i]), uint16_t(tile[1][i]), uint16_t(tile[2][i] + 1),
                           uint16_t(tile[3][i] + 1)};
      boxes[count] = box;
      Splat& s = splats[count];
      for (int k = 0; k < 3; ++k) *(F4*)(&s.x + 4 * k) = *(const F4*)rows[k][i];
      depths[count] = s.z;
      s.width = uint32_t(box.x1 - box.x0);
      s.instance = instances - box.y0 * s.width - box.x0;
      instances += s.width * uint32_t(box.y1 - box.y0);
      index[count++] = batch[i];
    }
  }
  return count;
}

/// Chain rule from the sums of the blending pass to the parameters, for the visible Gaussians
/// index[0..count). Instance after instance, one for each tile of boxes[i], row_of tells the row.
/// `camera` may be null; else the six derivatives by the pose are added to it.
static void projectRangeBackward(const GaussianArrays& g, const RasterView& v, const int32_t* index,
                                 int count, const TileBox* boxes, const uint32_t* row_of,
                                 const GradientRow* rows, const float* extra_rows,
                                 const GradientArrays& out, double* camera) {
  const int coefficients = (g.sh_degree + 1) * (g.sh_degree + 1);
  const int extra_stride = extraStride(g.extra_count);
  const float* w = v.camera_from_world;
  const F16 zero = {};
  F16 pose[6] = {zero, zero, zero, zero, zero, zero};
  int next = 0;
  while (next < count) {
    // The next sixteen that some pixel saw; the rest have no gradient.
    alignas(64) int32_t batch[kLanes];
    int32_t lane_index[kLanes];
    const uint32_t* instances[kLanes];
    int tiles_of[kLanes];
    alignas(64) float sums[kLanes][16], lane_valid[kLanes];
    int lanes = 0;
    for (; lanes < kLanes && next < count; ++next) {
      const int tiles = (boxes[next].x1 - boxes[next].x0) * (boxes[next].y1 - boxes[next].y0);
      batch[lanes] = index[next], instances[lanes] = row_of, tiles_of[lanes] = tiles;
      F16 sum = {};
      bool seen = false;
      for (int t = 0; t < tiles; ++t) {
        __builtin_prefetch(&rows[row_of[t + kAhead]]);  // kNoRow's address is harmless
        if (row_of[t] == kNoRow) continue;
        sum += load(rows[row_of[t]].v);
        seen = true;
      }
      store(sum, sums[lanes]);
      lanes += seen;
      row_of += tiles;
    }
    if (lanes == 0) break;
    for (int i = 0; i < kLanes; ++i) {
      lane_index[i] = i < lanes ? i : lanes - 1, lane_valid[i] = i < lanes ? 1.f : 0.f;
      batch[i] = batch[lane_index[i]];
    }
    Projected p;
    projectBatch(g, v, batch, &p);
    F16 column[16];
    gatherRows(sums[0], lane_index, 16, 16, column);
    const F16 h = column[kSumH], hx = column[kSumHx], hy = column[kSumHy], hxx = column[kSumHxx],
              hxy = column[kSumHxy], hyy = column[kSumHyy], d_depth = column[kSumZ];
    const F16 qa = p.cov[2] * p.inv_det, qb = -p.cov[1] * p.inv_det, qc = p.cov[0] * p.inv_det;

    // alpha = o exp(-(Qa dx^2 + 2 Qb dx dy + Qc dy^2) / 2), d = pixel - mean; h = dL/dalpha alpha.
    const F16 d_px = qa * hx + qb * hy, d_py = qb * hx + qc * hy;
    // dL/dCov = Q S Q / 2 with S = sum h d dt (from dL/dQ = -S / 2): the off-diagonal of the
    // symmetric matrix stands for two equal entries.
    const F16 m00 = qa * hxx + qb * hxy, m01 = qa * hxy + qb * hyy;
    const F16 m10 = qb * hxx + qc * hxy, m11 = qb * hxy + qc * hyy;
    const F16 d_xx = m00 * qa + m01 * qb, d_xy = m00 * qb + m01 * qc, d_yy = m10 * qb + m11 * qc;
    F16 d_c[6], d_log_scale[3], d_b[6];
    for (int k = 0; k < 3; ++k) {
      d_c[k] = d_xx * p.c[k] + d_xy * p.c[3 + k];
      d_c[3 + k] = d_xy * p.c[k] + d_yy * p.c[3 + k];
    }
    if (v.antialias) {
      // log alpha has (log det - log det_with) / 2 more; det_with = det + l trace + l^2.
      const F16 d_det = 0.5f * h * (1.f / p.det - p.inv_det);
      const F16 d_trace = -0.5f * v.low_pass * h * p.inv_det;
      F16 d_normal[3], d_c0[3], d_c1[3];
      for (int j = 0; j < 3; ++j) d_normal[j] = 2.f * d_det * p.normal[j];
      cross(p.c + 3, d_normal, d_c0);
      cross(d_normal, p.c, d_c1);
      for (int k = 0; k < 3; ++k) {
        d_c[k] += d_c0[k] + 2.f * d_trace * p.c[k];
        d_c[3 + k] += d_c1[k] + 2.f * d_trace * p.c[3 + k];
      }
    }
    for (int k = 0; k < 3; ++k) {
      d_log_scale[k] = d_c[k] * p.c[k] + d_c[3 + k] * p.c[3 + k];
      d_b[k] = d_c[k] * p.scale[k];
      d_b[3 + k] = d_c[3 + k] * p.scale[k];
    }
    F16 d_a[6], dr[9];
    for (int j = 0; j < 3; ++j) {
      const F16* r = p.rotation + 3 * j;
      d_a[j] = d_b[0] * r[0] + d_b[1] * r[1] + d_b[2] * r[2];
      d_a[3 + j] = d_b[3] * r[0] + d_b[4] * r[1] + d_b[5] * r[2];
      for (int k = 0; k < 3; ++k)
        dr[3 * j + k] = p.jacobian_world[j] * d_b[k] + p.jacobian_world[3 + j] * d_b[3 + k];
    }
    const F16 qw = p.quaternion[0], qx = p.quaternion[1], qy = p.quaternion[2],
              qz = p.quaternion[3];
    F16 d_q[4];
    d_q[0] = 2.f * (qz * (dr[3] - dr[1]) + qy * (dr[2] - dr[6]) + qx * (dr[7] - dr[5]));
    d_q[1] = 2.f * (qy * (dr[1] + dr[3]) + qz * (dr[2] + dr[6]) + qw * (dr[7] - dr[5]) -
                    2.f * qx * (dr[4] + dr[8]));
    d_q[2] = 2.f * (qx * (dr[1] + dr[3]) + qz * (dr[5] + dr[7]) + qw * (dr[2] - dr[6]) -
                    2.f * qy * (dr[0] + dr[8]));
    d_q[3] = 2.f * (qx * (dr[2] + dr[6]) + qy * (dr[5] + dr[7]) + qw * (dr[3] - dr[1]) -
                    2.f * qz * (dr[0] + dr[4]));
    const F16 radial = d_q[0] * qw + d_q[1] * qx + d_q[2] * qy + d_q[3] * qz;
    for (int j = 0; j < 4; ++j) d_q[j] = (d_q[j] - p.quaternion[j] * radial) * p.inv_norm;

    // A = (f / z) (W_xy - (xc, yc) W_z).
    F16 sx = {}, sy = {}, s_xc = {}, s_yc = {};
    for (int j = 0; j < 3; ++j) {
      sx += d_a[j] * (w[j] - p.xc * w[6 + j]);
      sy += d_a[3 + j] * (w[3 + j] - p.yc * w[6 + j]);
      s_xc -= d_a[j] * w[6 + j];
      s_yc -= d_a[3 + j] * w[6 + j];
    }
    const F16 jx = v.fx * p.inv_z, jy = v.fy * p.inv_z;
    const F16 d_xn = v.fx * d_px + select(p.xc == p.xn, jx * s_xc, zero);
    const F16 d_yn = v.fy * d_py + select(p.yc == p.yn, jy * s_yc, zero);
    const F16 d_x = d_xn * p.inv_z, d_y = d_yn * p.inv_z;
    const F16 d_z = d_depth - p.inv_z * (jx * sx + jy * sy + d_xn * p.xn + d_yn * p.yn);
    F16 d_mean[3];
    for (int j = 0; j < 3; ++j) d_mean[j] = w[j] * d_x + w[3 + j] * d_y + w[6 + j] * d_z;

    F16 d_colour[3] = {column[kSumRed], column[kSumGreen], column[kSumBlue]};
    for (int j = 0; j < 3; ++j) d_colour[j] = select(p.colour[j] > 0.f, d_colour[j], zero);
    if (g.sh_degree > 0) {
      F16 weight[16], d[3] = {};
      for (int k = 1; k < coefficients; ++k) {
        weight[k] = zero;
        for (int j = 0; j < 3; ++j) weight[k] += d_colour[j] * p.sh[3 * k + j];
      }
      shBasisGradient(g.sh_degree, p.direction[0], p.direction[1], p.direction[2], weight, d);
      const F16 along = d[0] * p.direction[0] + d[1] * p.direction[1] + d[2] * p.direction[2];
      for (int j = 0; j < 3; ++j) d_mean[j] += (d[j] - p.direction[j] * along) * p.inv_distance;
    }
    const F16 d_logit = h * (1.f - p.opacity);

    // Overflow somewhere on the way (an extreme Gaussian, an infinite loss): no gradient.
    F16 check = d_logit + d_colour[0] + d_colour[1] + d_colour[2];
    for (int j = 0; j < 3; ++j) check += d_mean[j] + d_log_scale[j];
    for (int j = 0; j < 4; ++j) check += d_q[j];
    check *= 0.f;
    if (camera) {
      // World_from_camera * exp(xi): points move by -(omega x p) - v seen from the camera, and
      // camera_from_world turns by -omega, which A = J W feels. The eye moves by v, W stays for it.
      const F16 d_p[3] = {d_x, d_y, d_z}, at[3] = {p.x, p.y, p.z};
      F16 twist[6];
      cross(d_p, at, twist);
      F16 e[6];  // dL/dA Wt [2, 3]
      for (int j = 0; j < 3; ++j)
        for (int r = 0; r < 2; ++r)
          e[3 * r + j] =
              d_a[3 * r] * w[3 * j] + d_a[3 * r + 1] * w[3 * j + 1] + d_a[3 * r + 2] * w[3 * j + 2];
      // M = Jt e, of which [omega]x takes the antisymmetric part.
      F16 m[9];
      for (int j = 0; j < 3; ++j) {
        m[j] = jx * e[j], m[3 + j] = jy * e[3 + j];
        m[6 + j] = -(m[j] * p.xc) - m[3 + j] * p.yc;
      }
      twist[0] -= m[7] - m[5], twist[1] -= m[2] - m[6], twist[2] -= m[3] - m[1];
      for (int j = 0; j < 3; ++j)
        twist[3 + j] =
            -(w[3 * j] * d_mean[0] + w[3 * j + 1] * d_mean[1] + w[3 * j + 2] * d_mean[2]);
      F16 bad = zero;
      for (int j = 0; j < 6; ++j) bad += twist[j] * 0.f;
      const I16 counts = (check == 0.f) & (bad == 0.f) & (load(lane_valid) > 0.f);
      for (int j = 0; j < 6; ++j) pose[j] += select(counts, twist[j], zero);
    }
    const F16 columns_out[16] = {d_mean[0],      d_mean[1],      d_mean[2],      d_logit,
                                 d_log_scale[0], d_log_scale[1], d_log_scale[2], zero,
                                 d_colour[0],    d_colour[1],    d_colour[2],    zero,
                                 d_q[0],         d_q[1],         d_q[2],         d_q[3]};
    alignas(64) float rows_out[4][kLanes][4], sane[kLanes], basis[16][kLanes];
    for (int k = 0; k < 4; ++k) transposeFour(columns_out + 4 * k, rows_out[k]);
    store(check, sane);
    for (int k = 0; k < coefficients; ++k) store(p.basis[k], basis[k]);
    for (int i = 0; i < lanes; ++i) {
      if (!(sane[i] == 0.f)) continue;
      const size_t n = size_t(batch[i]);
      __builtin_memcpy(out.mean + 3 * n, rows_out[0][i], 12);
      out.opacity_logit[n] = rows_out[0][i][3];
      __builtin_memcpy(out.log_scale + 3 * n, rows_out[1][i], 12);
      __builtin_memcpy(out.rotation + 4 * n, rows_out[3][i], 16);
      float* sh = out.sh + n * size_t(3 * coefficients);
      for (int k = 0; k < coefficients; ++k)
        for (int j = 0; j < 3; ++j) *sh++ = basis[k][i] * rows_out[2][i][j];
    }
    if (!extra_rows) continue;
    for (int i = 0; i < lanes; ++i) {
      float* to = out.extra + size_t(batch[i]) * size_t(g.extra_count);
      for (int c = 0; c < g.extra_count; ++c) {
        const int at = c / 16 * 16 + columnOfTerm(c % 16);
        float sum = 0.f;
        for (int t = 0; t < tiles_of[i]; ++t)
          if (instances[i][t] != kNoRow)
            sum += extra_rows[size_t(instances[i][t]) * size_t(extra_stride) + size_t(at)];
        to[c] = sum * 0.f == 0.f ? sum : 0.f;
      }
    }
  }
  if (!camera) return;
  for (int j = 0; j < 6; ++j) {
    alignas(64) float lane[kLanes];
    store(pose[j], lane);
    for (int i = 0; i < kLanes; ++i) camera[j] += double(lane[i]);
  }
}

// --- blending
// --------------------------------------------------------------------------------------

/// Pixel centres of block b (row-major, 4 x 4 blocks of 4 x 4 pixels) of the tile at (x0, y0).
VDBC_INLINE void blockCentres(int x0, int y0, int b, F16* x, F16* y) {
  alignas(64) static const float lane_x[kLanes] = {0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f,
                                                   0.5f, 1.5f, 2.5f, 3.5f, 0.5f, 1.5f, 2.5f, 3.5f};
  alignas(64) static const float lane_y[kLanes] = {0.5f, 0.5f, 0.5f, 0.5f, 1.5f, 1.5f, 1.5f, 1.5f,
                                                   2.5f, 2.5f, 2.5f, 2.5f, 3.5f, 3.5f, 3.5f, 3.5f};
  *x = load(lane_x) + float(x0 + (b % 4) * 4);
  *y = load(lane_y) + float(y0 + (b / 4) * 4);
}

/// Bit b of masks[s]: whether splat s can reach block b of the tile at (x0, y0), that is whether
/// the minimum of its quadratic form over the rectangle of the block's pixel centres is small
/// enough for alpha to reach the minimum.
VDBC_INLINE void blockMasks(const Splat* splats, const RasterView& v, int n, int x0, int y0,
                            uint16_t* masks) {
  for (int first = 0; first < n; first += kLanes) {
    int32_t lanes[kLanes];
    for (int i = 0; i < kLanes; ++i) lanes[i] = first + i < n ? first + i : n - 1;
    F16 column[8];
    gatherRows(&splats->x, lanes, sizeof(Splat) / sizeof(float), 8, column);
    const F16 x = column[0], y = column[1], a = column[2], b = column[3], c = column[4],
              cut = (column[5] - v.log2_min_alpha) * 1.001f + 0.01f;
    // A convex form centred at 0 is least on an edge that faces 0 (or at 0 itself). For a column of
    // blocks: the facing x, the y that is best there, and the form as p + y (q + c y); rows alike.
    const F16 along_x = b * -0.5f / a, along_y = b * -0.5f / c, zero = {};
    F16 left[4], best_y[4], p_x[4], q_x[4], top[4], best_x[4], p_y[4], q_y[4];
    for (int k = 0; k < 4; ++k) {
      left[k] = float(x0 + 4 * k) + 0.5f - x, top[k] = float(y0 + 4 * k) + 0.5f - y;
      const F16 ex = clampTo(zero, left[k], left[k] + 3.f);
      const F16 ey = clampTo(zero, top[k], top[k] + 3.f);
      best_y[k] = along_y * ex, p_x[k] = a * ex * ex - cut, q_x[k] = b * ex;
      best_x[k] = along_x * ey, p_y[k] = c * ey * ey - cut, q_y[k] = b * ey;
    }
    I16 mask = {};
    for (int block = 0; block < 16; ++block) {
      const int i = block % 4, j = block / 4;
      const F16 fy = clampTo(best_y[i], top[j], top[j] + 3.f);
      const F16 fx = clampTo(best_x[j], left[i], left[i] + 3.f);
      const F16 q1 = p_x[i] + fy * (q_x[i] + c * fy), q2 = p_y[j] + fx * (q_y[j] + a * fx);
      mask |= (smaller(q1, q2) <= 0.f) & (1 << block);
    }
    for (int i = 0; i < kLanes && first + i < n; ++i) masks[first + i] = uint16_t(mask[i]);
  }
}

/// alpha of one splat at 16 pixels: 0 where it is below the minimum, at most max_alpha.
VDBC_INLINE F16 alphaOf(const Splat& s, const RasterView& v, F16 dx, F16 dy) {
  // At most the opacity, whatever rounding does to a needle's form.
  const F16 e = smaller(s.log2_opacity - dx * (s.a * dx + s.b * dy) - s.c * dy * dy,
                        broadcast(s.log2_opacity));
  const F16 alpha = select(e >= v.log2_min_alpha, exp2Inside(e), F16{});
  return smaller(alpha, broadcast(v.max_alpha));
}

VDBC_INLINE const float* extraOf(const ExtraJob& extra, int32_t slot) {
  return extra.values + int64_t(extra.count) * extra.index[slot];
}

/// Copies n splats and asks for those of the next chunk, `left` being how many there are in all.
VDBC_INLINE void copySplats(const Splat* splats, const int32_t* list, int n, int left, Splat* to) {
  for (int s = 0; s < n; ++s) {
    if (s + kChunk < left) __builtin_prefetch(&splats[list[s + kChunk]]);
    to[s] = splats[list[s]];
  }
}

/// Blends list[0..count) (front to back) over one tile. `masks` may be null; else it keeps the
/// block masks, and `stops` per block how many of the list it looked at.
VDBC_INLINE void blendTileWith(const TileJob& job, uint16_t* masks, int32_t* stops,
                               TilePixels* saved, bool extended) {
  const RasterView& v = *job.view;
  const ExtraJob& extra = job.extra;
  alignas(64) Splat local[kChunk];
  uint16_t local_masks[kChunk], selected[kChunk + kLanes];
  alignas(64) F16 transmittance[16];
  alignas(64) F16 sums[16][5];  // red, green, blue, weight, weight * z
  alignas(64) F16 medians[16];
  uint32_t live = 0;
  const F16 zero = {};
  for (int b = 0; b < 16; ++b) {
    F16 x, y;
    blockCentres(job.x0, job.y0, b, &x, &y);
    transmittance[b] = select((x < float(v.width)) & (y < float(v.height)), broadcast(1.f), zero);
    for (int j = 0; j < 5; ++j) sums[b][j] = zero;
    if (anyAbove(transmittance[b], 0.f)) live |= 1u << b;
    stops[b] = 0;
    if (!extended) continue;
    medians[b] = zero;
    for (int c = 0; c < extra.count; ++c)
      store(zero, extra.blocks + (b * extra.count + c) * kLanes);
  }
  const uint32_t inside = live;
  for (int done = 0; done < job.count && live; done += kChunk) {
    const int n = job.count - done < kChunk ? job.count - done : kChunk;
    copySplats(job.splats, job.list + done, n, job.count - done, local);
    uint16_t* chunk_masks = masks ? masks + done : local_masks;
    blockMasks(local, v, n, job.x0, job.y0, chunk_masks);
    for (int b = 0; b < 16; ++b) {
      if (!(live >> b & 1)) continue;
      const int selected_count = selectByBit(chunk_masks, n, b, selected);
      F16 x, y;
      blockCentres(job.x0, job.y0, b, &x, &y);
      F16 t = transmittance[b];
      F16 red = sums[b][0], green = sums[b][1], blue = sums[b][2], weight = sums[b][3],
          depth = sums[b][4];
      F16 median = extended ? medians[b] : zero;
      stops[b] = done + n;
      for (int first = 0; first < selected_count; first += kBatch) {
        const int m = selected_count - first < kBatch ? selected_count - first : kBatch;
        F16 alphas[kBatch];
        for (int i = 0; i < m; ++i) {
          const Splat& s = local[selected[first + i]];
          alphas[i] = alphaOf(s, v, x - s.x, y - s.y);
        }
        for (int i = 0; i < m; ++i) {
          const int k = first + i;
          const Splat& s = local[selected[k]];
          const F16 wt = alphas[i] * t;
          red += wt * s.colour[0];
          green += wt * s.colour[1];
          blue += wt * s.colour[2];
          weight += wt;
          depth += wt * s.z;
          const F16 before = t;
          t -= wt;
          if (extended) {
            median = select((before > 0.5f) & (t <= 0.5f), broadcast(s.z), median);
            if (extra.count) {
              const float* values = extraOf(extra, job.list[done + selected[k]]);
              float* to = extra.blocks + b * extra.count * kLanes;
              for (int c = 0; c < extra.count; ++c, to += kLanes)
                store(load(to) + wt * values[c], to);
            }
          }
        }
        if (m == kBatch && !anyAbove(t, kOpaque)) {
          stops[b] = done + selected[first + kBatch - 1] + 1;
          live &= ~(1u << b);
          break;
        }
      }
      transmittance[b] = t;
      sums[b][0] = red, sums[b][1] = green, sums[b][2] = blue, sums[b][3] = weight,
      sums[b][4] = depth;
      if (extended) medians[b] = median;
    }
  }
  for (int b = 0; b < 16; ++b) {
    if (!(inside >> b & 1)) continue;
    const F16 t = transmittance[b];
    F16 pixel[5];
    for (int j = 0; j < 3; ++j) pixel[j] = sums[b][j] + t * v.background[j];
    pixel[3] = sums[b][3];
    pixel[4] = select(sums[b][3] > 0.f, sums[b][4] / sums[b][3], zero);
    alignas(64) float lanes[6][kLanes];
    for (int j = 0; j < 5; ++j) store(pixel[j], lanes[j]);
    if (extended) store(medians[b], lanes[5]);
    const int x0 = job.x0 + (b % 4) * 4, y0 = job.y0 + (b / 4) * 4;
    for (int i = 0; i < kLanes; ++i) {
      const int x = x0 + i % 4, y = y0 + i / 4;
      if (x >= v.width || y >= v.height) continue;
      const size_t at = size_t(y) * size_t(v.width) + size_t(x);
      for (int j = 0; j < 3; ++j) job.colour[3 * at + size_t(j)] = lanes[j][i];
      job.alpha[at] = lanes[3][i];
      job.depth[at] = lanes[4][i];
      if (!extended) continue;
      if (job.median_depth) job.median_depth[at] = lanes[5][i];
      for (int c = 0; c < extra.count; ++c)
        extra.image[at * size_t(extra.count) + size_t(c)] =
            extra.blocks[(b * extra.count + c) * kLanes + i];
    }
    if (saved)
      for (int j = 0; j < 5; ++j) store(pixel[j], saved->v[b][j]);
  }
}
static void blendTile(const TileJob& job, uint16_t* masks, int32_t* stops, TilePixels* saved) {
  if (job.extra.count || job.median_depth)
    blendTileWith(job, masks, stops, saved, true);
  else
    blendTileWith(job, masks, stops, saved, false);
}

/// Replays one tile front to back. Writes a gradient row for each splat that a pixel saw.
VDBC_INLINE void blendTileBackwardWith(const TileBackwardJob& job, bool extended) {
  const RasterView& v = *job.view;
  const ExtraJob& extra = job.extra;
  const int extra_stride = extraStride(extra.count);
  alignas(64) Splat local[kChunk];
  alignas(64) GradientRow rows[kChunk];
  uint16_t selected[kChunk + kLanes];
  uint8_t seen[kChunk];
  // Per block: d_red, d_green, d_blue, d_weight, d_weighted_z, then what is left of
  // D = sum_i w_i v_i + T d_background, of which the splats behind the present one are the suffix.
  alignas(64) F16 pixel[16][6];
  alignas(64) F16 transmittance[16];
  alignas(64) F16 d_medians[16];
  const F16 zero = {};
  for (int b = 0; b < 16; ++b) {
    const int x0 = job.x0 + (b % 4) * 4, y0 = job.y0 + (b / 4) * 4;
    alignas(64) float lanes[7][kLanes] = {};  // d by channel, 1 inside the image, d of the median
    for (int i = 0; i < kLanes; ++i) {
      const int x = x0 + i % 4, y = y0 + i / 4;
      if (x >= v.width || y >= v.height) continue;
      const size_t at = size_t(y) * size_t(v.width) + size_t(x);
      for (int j = 0; j < 3; ++j) lanes[j][i] = job.d_colour[3 * at + size_t(j)];
      if (job.d_alpha) lanes[3][i] = job.d_alpha[at];
      if (job.d_depth) lanes[4][i] = job.d_depth[at];
      lanes[5][i] = 1.f;
      if (extended && job.d_median_depth) lanes[6][i] = job.d_median_depth[at];
    }
    transmittance[b] = load(lanes[5]);
    const bool inside = x0 < v.width && y0 < v.height;  // else the saved block was never written
    F16 d[5], out[5];
    for (int j = 0; j < 5; ++j) {
      d[j] = load(lanes[j]);
      out[j] = inside ? load(job.saved->v[b][j]) : zero;
    }
    for (int j = 0; j < 3; ++j) pixel[b][j] = d[j];
    // depth = Z / A: dZ = d / A, dA = -d depth / A. Their shares of D cancel.
    const F16 d_z = select(out[3] > 0.f, d[4] / out[3], zero);
    pixel[b][3] = d[3] - d_z * out[4];
    pixel[b][4] = d_z;
    pixel[b][5] = d[0] * out[0] + d[1] * out[1] + d[2] * out[2] + d[3] * out[3];
    if (!extended) continue;
    d_medians[b] = load(lanes[6]);
    for (int c = 0; c < extra.count; ++c) {
      alignas(64) float d_lanes[kLanes] = {};
      for (int i = 0; i < kLanes; ++i) {
        const int x = x0 + i % 4, y = y0 + i / 4;
        if (x < v.width && y < v.height)
          d_lanes[i] =
              extra.d_image[(size_t(y) * size_t(v.width) + size_t(x)) * size_t(extra.count) +
                            size_t(c)];
      }
      const int block = (b * extra.count + c) * kLanes;
      store(load(d_lanes), extra.d_blocks + block);
      if (inside) pixel[b][5] += load(d_lanes) * load(extra.blocks + block);
    }
  }
  int last_stop = 0;
  for (int b = 0; b < 16; ++b) last_stop = job.stops[b] > last_stop ? job.stops[b] : last_stop;
  uint32_t next_row = job.first_row;
  for (int done = 0; done < last_stop; done += kChunk) {
    const int n = last_stop - done < kChunk ? last_stop - done : kChunk;
    copySplats(job.splats, job.list + done, n, last_stop - done, local);
    for (int s = 0; s < n; ++s) {
      store(zero, rows[s].v);
      seen[s] = 0;
    }
    if (extended && extra.count)
      for (int i = 0; i < n * extra_stride; i += kLanes)
        store(zero, extra.rows + size_t(next_row) * size_t(extra_stride) + i);
    for (int b = 0; b < 16; ++b) {
      const int limit = job.stops[b] - done < n ? job.stops[b] - done : n;
      if (limit <= 0) continue;
      const int selected_count = selectByBit(job.masks + done, limit, b, selected);
      F16 x, y;
      blockCentres(job.x0, job.y0, b, &x, &y);
      const F16 d_red = pixel[b][0], d_green = pixel[b][1], d_blue = pixel[b][2],
                d_weight = pixel[b][3], d_z = pixel[b][4];
      F16 suffix = pixel[b][5], t = transmittance[b];
      const float* d_channels = extra.d_blocks + b * extra.count * kLanes;
      for (int first = 0; first < selected_count; first += kBatch) {
        const int m = selected_count - first < kBatch ? selected_count - first : kBatch;
        F16 alphas[kBatch], odds[kBatch], weights[kBatch], h_of[kBatch], z_of[kBatch];
        for (int i = 0; i < m; ++i) {
          const Splat& s = local[selected[first + i]];
          alphas[i] = alphaOf(s, v, x - s.x, y - s.y);
          odds[i] = alphas[i] / (1.f - alphas[i]);
        }
        for (int i = 0; i < m; ++i) {
          const int k = first + i;
          const Splat& s = local[selected[k]];
          const F16 alpha = alphas[i];
          const F16 wt = alpha * t;
          F16 value = d_weight + d_red * s.colour[0] + d_green * s.colour[1] +
                      d_blue * s.colour[2] + d_z * s.z;
          if (extended && extra.count) {
            const float* values = extraOf(extra, job.list[done + selected[k]]);
            for (int c = 0; c < extra.count; ++c)
              value += load(d_channels + c * kLanes) * values[c];
          }
          suffix -= wt * value;
          const F16 h = wt * value - suffix * odds[i];
          h_of[i] = select(alpha < v.max_alpha, h, zero);
          weights[i] = wt;
          const F16 before = t;
          t -= wt;
          z_of[i] = wt * d_z;
          if (extended) z_of[i] += select((before > 0.5f) & (t <= 0.5f), d_medians[b], zero);
        }
        for (int i = 0; i < m; ++i) {
          const int k = first + i;
          const Splat& s = local[selected[k]];
          const F16 dx = x - s.x, dy = y - s.y, wt = weights[i], h = h_of[i];
          const F16 hy = h * dy;
          // Rows of pixels are summed first: [h, hy, hyy, red] and [green, blue, z, z] by columns.
          const F16 p = addQuarters(addHalves(h, hy), addHalves(hy * dy, wt * d_red));
          const F16 q =
              addQuarters(addHalves(wt * d_green, wt * d_blue), addHalves(z_of[i], z_of[i]));
          const F16 px = p * dx;  // dx is the same in each row
          const F16 sums = addNeighbours(addPairs(p, px), addPairs(px * dx, q));
          seen[selected[k]] = 1;
          float* row = rows[selected[k]].v;
          store(load(row) + sums, row);
          if (extended && extra.count) {
            float* to = extra.rows + size_t(next_row + selected[k]) * size_t(extra_stride);
            for (int c = 0; c < extra.count; c += 16) {
              F16 more[16];
              for (int j = 0; j < 16; ++j)
                more[j] = c + j < extra.count ? wt * load(d_channels + (c + j) * kLanes) : zero;
              store(load(to + c) + sumLanes(more, 16), to + c);
            }
          }
        }
      }
      pixel[b][5] = suffix;
      transmittance[b] = t;
    }
    // Without extra channels only rows that a pixel saw are kept.
    for (int s = 0; s < n; ++s) {
      const int32_t slot = job.list[done + s];
      const uint32_t instance = job.range_instance[slot / kRange] + local[s].instance +
                                uint32_t(job.y0 / kTile) * local[s].width +
                                uint32_t(job.x0 / kTile);
      if (seen[s] || (extended && extra.count)) {
        job.rows[next_row] = rows[s], job.row_of[instance] = next_row++;
      }
    }
  }
}
static void blendTileBackward(const TileBackwardJob& job) {
  if (job.extra.count || job.d_median_depth)
    blendTileBackwardWith(job, true);
  else
    blendTileBackwardWith(job, false);
}

static const RasterKernels kKernels = {projectRange, projectRangeBackward, blendTile,
                                       blendTileBackward};

#undef VDBC_INLINE
#undef VDBC_MEMBER
