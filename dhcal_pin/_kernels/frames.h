/* Error frames of a chain, displaced by kinematic errors; transforms are (4, 4) in row-major order.

   A chain of b bodies (body 0 is the base link, one more per moving joint) has 2b + 2 error frames: 0 base,
   2j + 1 link j, 2j + 2 joint j + 1 (for the last body: the tip), 2b + 1 tool. Error i is a twist ξ_i = [v,
   ω] at error frame s_i with value x_i. The errors are sorted by s_i. The displacement of error frame s is

       E_s = exp(x_i·ξ_i)·exp(x_(i+1)·ξ_(i+1))·...    over the errors at s.

   The pose F_s of error frame s in its body, before its own displacement, follows from B_j (URDF link frame
   in body j), O_j (origin of joint j + 1, or the tip) and T (tool):

       F_0 = E_0⁻¹,  F_(2j+1) = B_j,  F_(2j+2) = B_j·E_(2j+1)·O_j,  F_tool = F_tip·E_tip·T.

   The derivative of the chain by x_i is the twist Ad(F_s·exp(x_h·ξ_h)·...·exp(x_(i-1)·ξ_(i-1)))·ξ_i of that
   body, with the product over the errors at s that precede i.

   Exponential of x·[v, ω] with θ = x·|ω| and the unit axis a = ω/|ω| (Rodrigues' formula):

       R = I + sin θ·[a]× + (1 - cos θ)·[a]×²,
       p = (θ·v + (1 - cos θ)·[a]×·v + (θ - sin θ)·[a]×²·v)/|ω|,

   with 1 - cos θ = 2·sin²(θ/2), which does not cancel at small angles. */

static const double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};

/* Compute out = a·b; out may be a or b. */
static void compose(double *out, const double *a, const double *b)
{
    double c[16];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++)
            c[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] +
                           (j == 3 ? a[4 * i + 3] : 0);
    memcpy(c + 12, identity + 12, 4 * sizeof(double));
    memcpy(out, c, sizeof c);
}

/* Compute the inverse of a rigid transform; out must not be `frame`. */
static void invert(double *out, const double *frame)
{
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            out[4 * i + j] = frame[4 * j + i];
        out[4 * i + 3] = -(frame[i] * frame[3] + frame[4 + i] * frame[7] + frame[8 + i] * frame[11]);
    }
    memcpy(out + 12, identity + 12, 4 * sizeof(double));
}

/* Compute exp(x·twist) for a twist [v, ω]. */
static void scaled_exp6(double *out, const double *twist, double x)
{
    const double *v = twist, *w = twist + 3, size = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    memcpy(out, identity, sizeof identity);
    if (size == 0) {
        for (int i = 0; i < 3; i++)
            out[4 * i + 3] = x * v[i];
        return;
    }
    const double angle = x * size, half = sin(0.5 * angle), sine = sin(angle), versine = 2 * half * half;
    const double a = w[0] / size, b = w[1] / size, c = w[2] / size;
    const double cross[9] = {0, -c, b, c, 0, -a, -b, a, 0};
    for (int i = 0; i < 3; i++) {
        double p = angle * v[i];
        for (int j = 0; j < 3; j++) {
            double square = 0;
            for (int k = 0; k < 3; k++)
                square += cross[3 * i + k] * cross[3 * k + j];
            out[4 * i + j] += sine * cross[3 * i + j] + versine * square;
            p += (versine * cross[3 * i + j] + (angle - sine) * square) * v[j];
        }
        out[4 * i + 3] = p / size;
    }
}

/* Compute out = Ad(frame)·twist, a twist of `frame` expressed in the frame's parent. */
static void transform_twist(double *out, const double *frame, const double *twist)
{
    const double x = frame[3], y = frame[7], z = frame[11];
    for (int i = 0; i < 3; i++) {
        const double *r = frame + 4 * i;
        out[i] = r[0] * twist[0] + r[1] * twist[1] + r[2] * twist[2];
        out[3 + i] = r[0] * twist[3] + r[1] * twist[4] + r[2] * twist[5];
    }
    out[0] += y * out[5] - z * out[4];
    out[1] += z * out[3] - x * out[5];
    out[2] += x * out[4] - y * out[3];
}

/* Compute the pose of an error frame in its body, before its own displacement.

   `displacements` of the preceding error frames must be complete. */
static void error_frame_pose(double *out, Size error_frame, Size bodies, const double *body_from_urdf,
                             const double *origins, const double *tool, const double *displacements)
{
    const Size body = (error_frame - 1) / 2;
    if (error_frame == 0)
        invert(out, displacements);
    else if (error_frame == 2 * bodies + 1) {
        error_frame_pose(out, error_frame - 1, bodies, body_from_urdf, origins, tool, displacements);
        compose(out, out, displacements + 16 * (error_frame - 1));
        compose(out, out, tool);
    } else if (error_frame % 2)
        memcpy(out, body_from_urdf + 16 * body, 16 * sizeof(double));
    else {
        compose(out, body_from_urdf + 16 * body, displacements + 16 * (error_frame - 1));
        compose(out, out, origins + 16 * body);
    }
}

/* Compute the displacements (2b + 2, 4, 4) of all error frames and the twists (p, 6) in body frames.

   The errors are sorted by their error frame; x (p) are their values. */
static void perturb_frames(Size bodies, Size p, const double *body_from_urdf, const double *origins,
                           const double *tool, const Size *error_frames, const double *twists,
                           const double *x, double *displacements, double *body_twists)
{
    for (Size i = 0; i < 2 * bodies + 2; i++)
        memcpy(displacements + 16 * i, identity, sizeof identity);
    double step[16], frame[16];
    for (Size i = 0; i < p; i++) {
        scaled_exp6(step, twists + 6 * i, x[i]);
        compose(displacements + 16 * error_frames[i], displacements + 16 * error_frames[i], step);
    }
    for (Size i = 0; i < p; i++) {
        if (!i || error_frames[i] != error_frames[i - 1])
            error_frame_pose(frame, error_frames[i], bodies, body_from_urdf, origins, tool, displacements);
        transform_twist(body_twists + 6 * i, frame, twists + 6 * i);
        scaled_exp6(step, twists + 6 * i, x[i]);
        compose(frame, frame, step);
    }
}
