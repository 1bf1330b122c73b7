// The inner loops of rasterize.cpp, which includes this file once per instruction set, each time in
// a namespace of its own under `#pragma GCC target`. (target_clones would not do: vector extensions
// are lowered for the default target before the clones are made.) Only raw pointers and built-ins
// here, so that no shared inline function is ever compiled for more than the oldest machine.
//
// Sixteen lanes are sixteen Gaussians when projecting and a block of 4 x 4 pixels when blending.

#define VDBC_INLINE static inline __attribute__((always_inline))
#define VDBC_MEMBER inline __attribute__((always_inline))

typedef float F8 __attribute__((vector_size(32), may_alias));

#ifdef __AVX512F__
typedef float F16 __attribute__((vector_size(64), may_alias));
typedef int32_t I16 __attribute__((vector_size(64), may_alias));

VDBC_INLINE F16 broadcast(float v) { return F16{v, v, v, v, v, v, v, v, v, v, v, v, v, v, v, v}; }
VDBC_INLINE F16 load(const float* from) { return *(const F16*)from; }
VDBC_INLINE void store(F16 v, float* to) { *(F16*)to = v; }
VDBC_INLINE F16 select(I16 condition, F16 a, F16 b) { return condition ? a : b; }
VDBC_INLINE F16 smaller(F16 a, F16 b) { return a < b ? a : b; }
VDBC_INLINE F16 larger(F16 a, F16 b) { return a > b ? a : b; }
VDBC_INLINE F16 squareRoot(F16 x) { return (F16)_mm512_sqrt_ps((__m512)x); }
VDBC_INLINE I16 bitsOf(F16 x) { return (I16)x; }
VDBC_INLINE F16 fromBits(I16 x) { return (F16)x; }
VDBC_INLINE F16 toFloat(I16 x) { return __builtin_convertvector(x, F16); }
VDBC_INLINE F8 foldHalves(F16 v) {
  return __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) +
         __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
}
VDBC_INLINE bool anyAbove(F16 x, float limit) {
  return _mm512_cmp_ps_mask((__m512)x, _mm512_set1_ps(limit), _CMP_GT_OQ) != 0;
}
/// Lane i takes base[stride * index[i]].
VDBC_INLINE F16 gather(const float* base, const int32_t* index, int stride) {
  F16 v;
  for (int i = 0; i < kLanes; ++i) v[i] = base[int64_t(stride) * index[i]];
  return v;
}
#else
// Without 512-bit registers g++ would compare vectors of sixteen element by element: pairs of
// eight.
typedef int32_t I8 __attribute__((vector_size(32), may_alias));
struct I16 {
  I8 lo, hi;
  VDBC_MEMBER int operator[](int i) const { return i < 8 ? lo[i] : hi[i - 8]; }
};
struct F16 {
  F8 lo, hi;
  VDBC_MEMBER float operator[](int i) const { return i < 8 ? lo[i] : hi[i - 8]; }
};
VDBC_INLINE F16 broadcast(float v) {
  const F8 half = {v, v, v, v, v, v, v, v};
  return {half, half};
}
#define VDBC_OPERATOR(op)                                                            \
  VDBC_INLINE F16 operator op(F16 a, F16 b) { return {a.lo op b.lo, a.hi op b.hi}; } \
  VDBC_INLINE F16 operator op(F16 a, float b) { return a op broadcast(b); }          \
  VDBC_INLINE F16 operator op(float a, F16 b) { return broadcast(a) op b; }          \
  VDBC_INLINE F16& operator op##=(F16& a, F16 b) { return a = a op b; }              \
  VDBC_INLINE F16& operator op##=(F16& a, float b) { return a = a op b; }
VDBC_OPERATOR(+)
VDBC_OPERATOR(-)
VDBC_OPERATOR(*)
VDBC_OPERATOR(/)
#undef VDBC_OPERATOR
#define VDBC_OPERATOR(op)                                                                    \
  VDBC_INLINE I16 operator op(F16 a, F16 b) { return {I8(a.lo op b.lo), I8(a.hi op b.hi)}; } \
  VDBC_INLINE I16 operator op(F16 a, float b) { return a op broadcast(b); }
VDBC_OPERATOR(<)
VDBC_OPERATOR(>)
VDBC_OPERATOR(<=)
VDBC_OPERATOR(>=)
VDBC_OPERATOR(==)
#undef VDBC_OPERATOR
VDBC_INLINE F16 operator-(F16 a) { return {-a.lo, -a.hi}; }
VDBC_INLINE I16 operator&(I16 a, I16 b) { return {a.lo & b.lo, a.hi & b.hi}; }
VDBC_INLINE I16 operator&(I16 a, int b) { return {a.lo & b, a.hi & b}; }
VDBC_INLINE I16& operator|=(I16& a, I16 b) { return a = {a.lo | b.lo, a.hi | b.hi}; }
VDBC_INLINE I16 operator+(I16 a, I16 b) { return {a.lo + b.lo, a.hi + b.hi}; }
VDBC_INLINE I16 operator-(I16 a, I16 b) { return {a.lo - b.lo, a.hi - b.hi}; }
VDBC_INLINE I16 operator-(I16 a, int b) { return {a.lo - b, a.hi - b}; }
VDBC_INLINE I16 operator<<(I16 a, int n) { return {a.lo << n, a.hi << n}; }
VDBC_INLINE I16 operator>>(I16 a, int n) { return {a.lo >> n, a.hi >> n}; }
VDBC_INLINE F16 load(const float* from) { return {((const F8*)from)[0], ((const F8*)from)[1]}; }
VDBC_INLINE void store(F16 v, float* to) { ((F8*)to)[0] = v.lo, ((F8*)to)[1] = v.hi; }
VDBC_INLINE F16 select(I16 condition, F16 a, F16 b) {
  return {condition.lo ? a.lo : b.lo, condition.hi ? a.hi : b.hi};
}
VDBC_INLINE F16 smaller(F16 a, F16 b) { return select(a < b, a, b); }
VDBC_INLINE F16 larger(F16 a, F16 b) { return select(a > b, a, b); }
VDBC_INLINE F16 squareRoot(F16 x) {
#ifdef __AVX__
  return {(F8)_mm256_sqrt_ps((__m256)x.lo), (F8)_mm256_sqrt_ps((__m256)x.hi)};
#else
  for (int i = 0; i < 8; ++i)
    x.lo[i] = __builtin_sqrtf(x.lo[i]), x.hi[i] = __builtin_sqrtf(x.hi[i]);
  return x;
#endif
}
VDBC_INLINE I16 bitsOf(F16 x) { return {(I8)x.lo, (I8)x.hi}; }
VDBC_INLINE F16 fromBits(I16 x) { return {(F8)x.lo, (F8)x.hi}; }
VDBC_INLINE F16 toFloat(I16 x) {
  return {__builtin_convertvector(x.lo, F8), __builtin_convertvector(x.hi, F8)};
}
VDBC_INLINE F8 foldHalves(F16 v) { return v.lo + v.hi; }
VDBC_INLINE bool anyAbove(F16 x, float limit) {
#ifdef __AVX__
  const F16 above = fromBits(x > limit);
  return _mm256_movemask_ps(_mm256_or_ps((__m256)above.lo, (__m256)above.hi)) != 0;
#else
  bool any = false;
  for (int i = 0; i < kLanes; ++i) any |= x[i] > limit;
  return any;
#endif
}
/// Lane i takes base[stride * index[i]].
VDBC_INLINE F16 gather(const float* base, const int32_t* index, int stride) {
  F16 v;
  for (int i = 0; i < 8; ++i) {
    v.lo[i] = base[int64_t(stride) * index[i]];
    v.hi[i] = base[int64_t(stride) * index[i + 8]];
  }
  return v;
}
#endif

VDBC_INLINE F16 clampTo(F16 x, F16 lo, F16 hi) { return smaller(larger(x, lo), hi); }

/// 2^x to 1e-7 relative; x below -126 counts as -126, above 127 as 127.
VDBC_INLINE F16 exp2Of(F16 x) {
  x = clampTo(x, broadcast(-126.f), broadcast(127.f));
  const F16 shifted = x + 12582912.f;  // 1.5 * 2^23: the nearest integer ends up in the low bits
  const F16 f = x - (shifted - 12582912.f);
  // Interpolates 2^f at the Chebyshev nodes of [-1/2, 1/2].
  F16 p = f * 0.00133908634f + 0.00967603192f;
  p = p * f + 0.0555035711f;
  p = p * f + 0.240221075f;
  p = p * f + 0.693147188f;
  p = p * f + 1.00000008f;
  return fromBits(bitsOf(p) + (bitsOf(shifted) << 23));
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
#ifdef __AVX512F__
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
  F16 opacity;
  F16 finite;     // 0, or NaN where log_scale or opacity_logit is not finite
  F16 colour[3];  // before the clamp at 0
  F16 basis[16], direction[3], inv_distance;
};

VDBC_INLINE void toCamera(const RasterView& v, const F16* from_eye, F16* x, F16* y, F16* z) {
  const float* r = v.camera_from_world;
  *x = r[0] * from_eye[0] + r[1] * from_eye[1] + r[2] * from_eye[2];
  *y = r[3] * from_eye[0] + r[4] * from_eye[1] + r[5] * from_eye[2];
  *z = r[6] * from_eye[0] + r[7] * from_eye[1] + r[8] * from_eye[2];
}

VDBC_INLINE void projectBatch(const GaussianArrays& g, const RasterView& v, const int32_t* index,
                              Projected* out) {
  Projected& p = *out;
  for (int j = 0; j < 3; ++j)
    p.from_eye[j] = (gather(g.mean + j, index, 3) - v.eye[j]) - v.eye_rest[j];
  toCamera(v, p.from_eye, &p.x, &p.y, &p.z);
  p.inv_z = 1.f / p.z;
  p.xn = p.x * p.inv_z, p.yn = p.y * p.inv_z;
  p.xc = clampTo(p.xn, broadcast(v.x_min), broadcast(v.x_max));
  p.yc = clampTo(p.yn, broadcast(v.y_min), broadcast(v.y_max));

  F16 q[4];
  for (int j = 0; j < 4; ++j) q[j] = gather(g.rotation + j, index, 4);
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
    const F16 log_scale = gather(g.log_scale + j, index, 3);
    p.scale[j] = exp2Of(log_scale * kLog2E);
    p.finite += log_scale * 0.f;
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
  const F16 n0 = c0[1] * c1[2] - c0[2] * c1[1], n1 = c0[2] * c1[0] - c0[0] * c1[2],
            n2 = c0[0] * c1[1] - c0[1] * c1[0];
  p.inv_det =
      1.f / (n0 * n0 + n1 * n1 + n2 * n2 + v.low_pass * (xx + yy) + v.low_pass * v.low_pass);
  const F16 logit = gather(g.opacity_logit, index, 1);
  p.opacity = 1.f / (1.f + exp2Of(logit * -kLog2E));
  p.finite += logit * 0.f;

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
  for (int k = 0; k < coefficients; ++k)
    for (int j = 0; j < 3; ++j)
      p.colour[j] += p.basis[k] * gather(g.sh + 3 * k + j, index, 3 * coefficients);
}

/// Projects Gaussians [begin, end); those that can touch the image go to splats, boxes and index,
/// which have room for end - begin. Returns how many.
static int projectRange(const GaussianArrays& g, const RasterView& v, int64_t begin, int64_t end,
                        Splat* splats, TileBox* boxes, int32_t* index) {
  // 1. A generous cull: no rotation, no opacity.
  int kept = 0;
  const float widest = 2.f * kLn2 * -v.log2_min_alpha;
  const float slope_x = 1.f + v.x_max * v.x_max + v.x_min * v.x_min;
  const float slope_y = 1.f + v.y_max * v.y_max + v.y_min * v.y_min;
  for (int64_t first = begin; first < end; first += kLanes) {
    const int lanes = end - first < kLanes ? int(end - first) : kLanes;
    alignas(64) int32_t batch[kLanes];
    for (int i = 0; i < kLanes; ++i) batch[i] = int32_t(first) + (i < lanes ? i : lanes - 1);
    F16 d[3], x, y, z;
    for (int j = 0; j < 3; ++j) d[j] = (gather(g.mean + j, batch, 3) - v.eye[j]) - v.eye_rest[j];
    toCamera(v, d, &x, &y, &z);
    const F16 log_scale =
        larger(larger(gather(g.log_scale, batch, 3), gather(g.log_scale + 1, batch, 3)),
               gather(g.log_scale + 2, batch, 3));
    const F16 scale = exp2Of(smaller(log_scale, broadcast(40.f)) * kLog2E);
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
  for (int first = 0; first < kept; first += kLanes) {
    const int lanes = kept - first < kLanes ? kept - first : kLanes;
    alignas(64) int32_t batch[kLanes];
    for (int i = 0; i < kLanes; ++i) batch[i] = index[first + (i < lanes ? i : lanes - 1)];
    Projected p;
    projectBatch(g, v, batch, &p);
    const F16 px = v.fx * p.xn + v.cx, py = v.fy * p.yn + v.cy;
    const F16 conic_a = p.cov[2] * p.inv_det, conic_b = -p.cov[1] * p.inv_det,
              conic_c = p.cov[0] * p.inv_det;
    const F16 log2_opacity = log2Of(larger(p.opacity, broadcast(1e-30f)));
    const F16 cut = log2_opacity - v.log2_min_alpha;
    // Radii of the level set alpha = min_alpha, a little generous: the test of alpha decides.
    const F16 reach = larger(cut, broadcast(0.f)) * (2.f * kLn2 * 1.0002f);
    const F16 rx = squareRoot(reach * p.cov[0]) + 0.002f;
    const F16 ry = squareRoot(reach * p.cov[2]) + 0.002f;
    const F16 sum = px + py + conic_a + conic_b + conic_c + p.opacity + p.colour[0] + p.colour[1] +
                    p.colour[2] + rx + ry + p.inv_norm + p.finite;
    // 0 * finite is 0, 0 * (infinity or NaN) is NaN.
    const I16 keep = (sum * 0.f == 0.f) & (cut >= 0.f) & (p.inv_det > 0.f) & (p.inv_norm > 0.f);
    const F16 zero = broadcast(0.f);
    const F16 x_lo = clampTo(px - rx - 0.5f, zero - 1.f, zero + float(v.width));
    const F16 x_hi = clampTo(px + rx - 0.5f, zero - 1.f, zero + float(v.width));
    const F16 y_lo = clampTo(py - ry - 0.5f, zero - 1.f, zero + float(v.height));
    const F16 y_hi = clampTo(py + ry - 0.5f, zero - 1.f, zero + float(v.height));
    for (int i = 0; i < lanes; ++i) {
      if (!keep[i]) continue;
      // First and last pixel whose centre is inside; + 2 and - 1 turn truncation into floor.
      int x0 = int(x_lo[i] + 2.f) - 1, x1 = int(x_hi[i] + 2.f) - 2;
      int y0 = int(y_lo[i] + 2.f) - 1, y1 = int(y_hi[i] + 2.f) - 2;
      if (x0 < 0) x0 = 0;
      if (y0 < 0) y0 = 0;
      if (x1 >= v.width) x1 = v.width - 1;
      if (y1 >= v.height) y1 = v.height - 1;
      if (x0 > x1 || y0 > y1) continue;
      boxes[count] = {uint16_t(x0 / kTile), uint16_t(y0 / kTile), uint16_t(x1 / kTile + 1),
                      uint16_t(y1 / kTile + 1)};
      Splat& s = splats[count];
      s.x = px[i], s.y = py[i];
      s.a = conic_a[i] * (0.5f * kLog2E);
      s.b = conic_b[i] * kLog2E;
      s.c = conic_c[i] * (0.5f * kLog2E);
      s.log2_opacity = log2_opacity[i];
      s.cut = cut[i];
      s.z = p.z[i];
      for (int j = 0; j < 3; ++j) s.colour[j] = p.colour[j][i] > 0.f ? p.colour[j][i] : 0.f;
      index[count++] = batch[i];
    }
  }
  return count;
}

VDBC_INLINE F16 columnOf(const float (*rows)[16], int column) {
  const int32_t lanes[kLanes] = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
  return gather(rows[0] + column, lanes, 16);
}

/// Chain rule from the sums of the blending pass to the parameters, for the visible Gaussians
/// index[0..count). Their rows in `rows` are first_row[i] up to first_row[i] + tiles of boxes[i].
static void projectRangeBackward(const GaussianArrays& g, const RasterView& v, const int32_t* index,
                                 int count, const TileBox* boxes, const uint32_t* first_row,
                                 const GradientRow* rows, const GradientArrays& out) {
  const int coefficients = (g.sh_degree + 1) * (g.sh_degree + 1);
  const float* w = v.camera_from_world;
  for (int first = 0; first < count; first += kLanes) {
    const int lanes = count - first < kLanes ? count - first : kLanes;
    alignas(64) int32_t batch[kLanes];
    alignas(64) float sums[kLanes][16];
    for (int i = 0; i < kLanes; ++i) {
      const int k = first + (i < lanes ? i : lanes - 1);
      batch[i] = index[k];
      const int tiles = (boxes[k].x1 - boxes[k].x0) * (boxes[k].y1 - boxes[k].y0);
      F16 sum = {};
      for (int t = 0; t < tiles; ++t) sum += load(rows[size_t(first_row[k]) + size_t(t)].v);
      store(sum, sums[i]);
    }
    Projected p;
    projectBatch(g, v, batch, &p);
    const F16 h = columnOf(sums, kSumH), hx = columnOf(sums, kSumHx), hy = columnOf(sums, kSumHy),
              hxx = columnOf(sums, kSumHxx), hxy = columnOf(sums, kSumHxy),
              hyy = columnOf(sums, kSumHyy), d_depth = columnOf(sums, kSumZ);
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
    const F16 zero = {};
    const F16 d_xn = v.fx * d_px + select(p.xc == p.xn, jx * s_xc, zero);
    const F16 d_yn = v.fy * d_py + select(p.yc == p.yn, jy * s_yc, zero);
    const F16 d_x = d_xn * p.inv_z, d_y = d_yn * p.inv_z;
    const F16 d_z = d_depth - p.inv_z * (jx * sx + jy * sy + d_xn * p.xn + d_yn * p.yn);
    F16 d_mean[3];
    for (int j = 0; j < 3; ++j) d_mean[j] = w[j] * d_x + w[3 + j] * d_y + w[6 + j] * d_z;

    F16 d_colour[3] = {columnOf(sums, kSumRed), columnOf(sums, kSumGreen),
                       columnOf(sums, kSumBlue)};
    for (int j = 0; j < 3; ++j) d_colour[j] = select(p.colour[j] > 0.f, d_colour[j], zero);
    if (g.sh_degree > 0) {
      F16 weight[16], d[3] = {};
      for (int k = 1; k < coefficients; ++k) {
        weight[k] = zero;
        for (int j = 0; j < 3; ++j)
          weight[k] += d_colour[j] * gather(g.sh + 3 * k + j, batch, 3 * coefficients);
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
    for (int i = 0; i < lanes; ++i) {
      if (!(check[i] == 0.f)) continue;
      const size_t n = size_t(batch[i]);
      for (int j = 0; j < 3; ++j) {
        out.mean[3 * n + size_t(j)] = d_mean[j][i];
        out.log_scale[3 * n + size_t(j)] = d_log_scale[j][i];
      }
      for (int j = 0; j < 4; ++j) out.rotation[4 * n + size_t(j)] = d_q[j][i];
      out.opacity_logit[n] = d_logit[i];
      float* sh = out.sh + n * size_t(3 * coefficients);
      for (int k = 0; k < coefficients; ++k)
        for (int j = 0; j < 3; ++j) *sh++ = p.basis[k][i] * d_colour[j][i];
    }
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
/// the minimum of its quadratic form over the rectangle of the block's pixel centres is below its
/// cut.
VDBC_INLINE void blockMasks(const Splat* splats, int n, int x0, int y0, uint16_t* masks) {
  for (int first = 0; first < n; first += kLanes) {
    int32_t lanes[kLanes];
    for (int i = 0; i < kLanes; ++i) lanes[i] = first + i < n ? first + i : n - 1;
    constexpr int kStride = sizeof(Splat) / sizeof(float);
    const F16 x = gather(&splats->x, lanes, kStride), y = gather(&splats->y, lanes, kStride),
              a = gather(&splats->a, lanes, kStride), b = gather(&splats->b, lanes, kStride),
              c = gather(&splats->c, lanes, kStride),
              cut = gather(&splats->cut, lanes, kStride) * 1.001f + 0.01f;
    const F16 along_x = b * -0.5f / a, along_y = b * -0.5f / c, zero = {};
    I16 mask = {};
    for (int block = 0; block < 16; ++block) {
      const F16 left = float(x0 + (block % 4) * 4) + 0.5f - x, right = left + 3.f;
      const F16 top = float(y0 + (block / 4) * 4) + 0.5f - y, bottom = top + 3.f;
      // A convex form centred at 0 is least on an edge that faces 0 (or at 0 itself).
      const F16 ex = clampTo(zero, left, right), ey = clampTo(zero, top, bottom);
      const F16 fy = clampTo(along_y * ex, top, bottom), fx = clampTo(along_x * ey, left, right);
      const F16 q1 = ex * (a * ex + b * fy) + c * fy * fy;
      const F16 q2 = fx * (a * fx + b * ey) + c * ey * ey;
      mask |= (smaller(q1, q2) <= cut) & (1 << block);
    }
    for (int i = 0; i < kLanes && first + i < n; ++i) masks[first + i] = uint16_t(mask[i]);
  }
}

/// alpha of one splat at 16 pixels, 0 where it is below the minimum; `live` is false there and
/// where alpha is clamped.
VDBC_INLINE F16 alphaOf(const Splat& s, const RasterView& v, F16 dx, F16 dy, I16* unclamped) {
  F16 q = dx * (s.a * dx + s.b * dy) + s.c * dy * dy;
  q = larger(q, F16{});  // rounding of a needle's form
  const F16 e = s.log2_opacity - q;
  F16 alpha = exp2Of(e);
  alpha = select(e >= v.log2_min_alpha, alpha, F16{});
  *unclamped = alpha < v.max_alpha;
  return smaller(alpha, broadcast(v.max_alpha));
}

/// Blends list[0..count) (front to back) over one tile. `masks` may be null; else it keeps the
/// block masks, and `stops` per block how many of the list it looked at.
static void blendTile(const TileJob& job, uint16_t* masks, int32_t* stops, TilePixels* saved) {
  const RasterView& v = *job.view;
  alignas(64) Splat local[kChunk];
  uint16_t local_masks[kChunk], selected[kChunk + kLanes];
  alignas(64) F16 transmittance[16];
  alignas(64) F16 sums[16][5];  // red, green, blue, weight, weight * z
  uint32_t live = 0;
  const F16 zero = {};
  for (int b = 0; b < 16; ++b) {
    F16 x, y;
    blockCentres(job.x0, job.y0, b, &x, &y);
    transmittance[b] = select((x < float(v.width)) & (y < float(v.height)), broadcast(1.f), zero);
    for (int j = 0; j < 5; ++j) sums[b][j] = zero;
    if (anyAbove(transmittance[b], 0.f)) live |= 1u << b;
    stops[b] = 0;
  }
  const uint32_t inside = live;
  for (int done = 0; done < job.count && live; done += kChunk) {
    const int n = job.count - done < kChunk ? job.count - done : kChunk;
    for (int s = 0; s < n; ++s) local[s] = job.splats[job.list[done + s]];
    uint16_t* chunk_masks = masks ? masks + done : local_masks;
    blockMasks(local, n, job.x0, job.y0, chunk_masks);
    for (int b = 0; b < 16; ++b) {
      if (!(live >> b & 1)) continue;
      const int selected_count = selectByBit(chunk_masks, n, b, selected);
      F16 x, y;
      blockCentres(job.x0, job.y0, b, &x, &y);
      F16 t = transmittance[b];
      F16 red = sums[b][0], green = sums[b][1], blue = sums[b][2], weight = sums[b][3],
          depth = sums[b][4];
      stops[b] = done + n;
      for (int k = 0; k < selected_count; ++k) {
        const Splat& s = local[selected[k]];
        I16 unclamped;
        const F16 alpha = alphaOf(s, v, x - s.x, y - s.y, &unclamped);
        const F16 wt = alpha * t;
        red += wt * s.colour[0];
        green += wt * s.colour[1];
        blue += wt * s.colour[2];
        weight += wt;
        depth += wt * s.z;
        t -= wt;
        if ((k & 7) == 7 && !anyAbove(t, kOpaque)) {
          stops[b] = done + selected[k] + 1;
          live &= ~(1u << b);
          break;
        }
      }
      transmittance[b] = t;
      sums[b][0] = red, sums[b][1] = green, sums[b][2] = blue, sums[b][3] = weight,
      sums[b][4] = depth;
    }
  }
  for (int b = 0; b < 16; ++b) {
    if (!(inside >> b & 1)) continue;
    const F16 t = transmittance[b];
    F16 pixel[5];
    for (int j = 0; j < 3; ++j) pixel[j] = sums[b][j] + t * v.background[j];
    pixel[3] = sums[b][3];
    pixel[4] = select(sums[b][3] > 0.f, sums[b][4] / sums[b][3], zero);
    const int x0 = job.x0 + (b % 4) * 4, y0 = job.y0 + (b / 4) * 4;
    for (int i = 0; i < kLanes; ++i) {
      const int x = x0 + i % 4, y = y0 + i / 4;
      if (x >= v.width || y >= v.height) continue;
      const size_t at = size_t(y) * size_t(v.width) + size_t(x);
      for (int j = 0; j < 3; ++j) job.colour[3 * at + size_t(j)] = pixel[j][i];
      job.alpha[at] = pixel[3][i];
      job.depth[at] = pixel[4][i];
    }
    if (saved)
      for (int j = 0; j < 5; ++j) store(pixel[j], saved->v[b][j]);
  }
}

/// [a.lo + a.hi, b.lo + b.hi] by quarters of sixteen.
VDBC_INLINE F8 pairHalves(F8 a, F8 b) {
  return __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11) +
         __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
}
VDBC_INLINE F8 pairQuarters(F8 a, F8 b) {
  return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13) +
         __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15);
}
VDBC_INLINE F8 pairNeighbours(F8 a, F8 b) {
  return __builtin_shufflevector(a, b, 0, 2, 8, 10, 4, 6, 12, 14) +
         __builtin_shufflevector(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
}

/// Replays one tile front to back. Writes one gradient row per entry of the list.
static void blendTileBackward(const TileBackwardJob& job) {
  const RasterView& v = *job.view;
  alignas(64) Splat local[kChunk];
  alignas(64) GradientRow rows[kChunk];
  uint16_t selected[kChunk + kLanes];
  // Per block: d_red, d_green, d_blue, d_weight, d_weighted_z, then what is left of
  // D = sum_i w_i v_i + T d_background, of which the splats behind the present one are the suffix.
  alignas(64) F16 pixel[16][6];
  alignas(64) F16 transmittance[16];
  const F16 zero = {};
  for (int b = 0; b < 16; ++b) {
    const int x0 = job.x0 + (b % 4) * 4, y0 = job.y0 + (b / 4) * 4;
    alignas(64) float lanes[6][kLanes] = {};  // d by channel, then 1 inside the image
    for (int i = 0; i < kLanes; ++i) {
      const int x = x0 + i % 4, y = y0 + i / 4;
      if (x >= v.width || y >= v.height) continue;
      const size_t at = size_t(y) * size_t(v.width) + size_t(x);
      for (int j = 0; j < 3; ++j) lanes[j][i] = job.d_colour[3 * at + size_t(j)];
      if (job.d_alpha) lanes[3][i] = job.d_alpha[at];
      if (job.d_depth) lanes[4][i] = job.d_depth[at];
      lanes[5][i] = 1.f;
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
  }
  for (int done = 0; done < job.count; done += kChunk) {
    const int n = job.count - done < kChunk ? job.count - done : kChunk;
    for (int s = 0; s < n; ++s) {
      local[s] = job.splats[job.list[done + s]];
      store(zero, rows[s].v);
    }
    for (int b = 0; b < 16; ++b) {
      const int limit = job.stops[b] - done < n ? job.stops[b] - done : n;
      if (limit <= 0) continue;
      const int selected_count = selectByBit(job.masks + done, limit, b, selected);
      F16 x, y;
      blockCentres(job.x0, job.y0, b, &x, &y);
      const F16 d_red = pixel[b][0], d_green = pixel[b][1], d_blue = pixel[b][2],
                d_weight = pixel[b][3], d_z = pixel[b][4];
      F16 suffix = pixel[b][5], t = transmittance[b];
      for (int k = 0; k < selected_count; ++k) {
        const Splat& s = local[selected[k]];
        const F16 dx = x - s.x, dy = y - s.y;
        I16 unclamped;
        const F16 alpha = alphaOf(s, v, dx, dy, &unclamped);
        const F16 wt = alpha * t;
        const F16 value = d_red * s.colour[0] + d_green * s.colour[1] + d_blue * s.colour[2] +
                          d_z * s.z + d_weight;
        suffix -= wt * value;
        F16 h = wt * value - suffix * alpha / (1.f - alpha);
        h = select(unclamped, h, zero);
        t -= wt;
        const F16 hx = h * dx, hy = h * dy;
        const F16 terms[10] = {h,       hx,         hy,           hx * dx,     hx * dy,
                               hy * dy, wt * d_red, wt * d_green, wt * d_blue, wt * d_z};
        F8 half[10];
        for (int j = 0; j < 10; ++j) half[j] = foldHalves(terms[j]);
        const F8 q01 = pairHalves(half[0], half[1]), q23 = pairHalves(half[2], half[3]),
                 q45 = pairHalves(half[4], half[5]), q67 = pairHalves(half[6], half[7]),
                 q89 = pairHalves(half[8], half[9]);
        const F8 low = pairNeighbours(pairQuarters(q01, q23), pairQuarters(q45, q67));
        const F8 e89 = pairQuarters(q89, q89);
        const F8 high = pairNeighbours(e89, e89);
        F8* row = (F8*)rows[selected[k]].v;
        row[0] += low;
        row[1] += high;
      }
      pixel[b][5] = suffix;
      transmittance[b] = t;
    }
    for (int s = 0; s < n; ++s) {
      const int32_t slot = job.list[done + s];
      const TileBox box = job.boxes[slot];
      const int k = (job.y0 / kTile - box.y0) * (box.x1 - box.x0) + (job.x0 / kTile - box.x0);
      job.rows[size_t(job.first_row[slot]) + size_t(k)] = rows[s];
    }
  }
}

static const RasterKernels kKernels = {projectRange, projectRangeBackward, blendTile,
                                       blendTileBackward};

#undef VDBC_INLINE
#undef VDBC_MEMBER
