/* Stations of a chain, moved by errors; frames are 4 by 4, by rows. */

static const double identity[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};

/* out = a b, which may be one of them. */
static void follow(double *out, const double *a, const double *b)
{
    double c[16];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 4; j++)
            c[4 * i + j] = a[4 * i] * b[j] + a[4 * i + 1] * b[4 + j] + a[4 * i + 2] * b[8 + j] +
                           (j == 3 ? a[4 * i + 3] : 0);
    memcpy(c + 12, identity + 12, 4 * sizeof(double));
    memcpy(out, c, sizeof c);
}

static void invert(double *out, const double *frame)
{
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 3; j++)
            out[4 * i + j] = frame[4 * j + i];
        out[4 * i + 3] = -(frame[i] * frame[3] + frame[4 + i] * frame[7] + frame[8 + i] * frame[11]);
    }
    memcpy(out + 12, identity + 12, 4 * sizeof(double));
}

/* The motion of a share x of a twist. */
static void exponential(double *out, const double *twist, double x)
{
    const double *v = twist, *w = twist + 3, size = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    memcpy(out, identity, sizeof identity);
    if (size == 0) {
        for (int i = 0; i < 3; i++)
            out[4 * i + 3] = x * v[i];
        return;
    }
    const double angle = x * size, half = sin(0.5 * angle), sine = sin(angle), across = 2 * half * half;
    const double a = w[0] / size, b = w[1] / size, c = w[2] / size;
    const double cross[9] = {0, -c, b, c, 0, -a, -b, a, 0};
    for (int i = 0; i < 3; i++) {
        double along = angle * v[i];
        for (int j = 0; j < 3; j++) {
            double square = 0;
            for (int k = 0; k < 3; k++)
                square += cross[3 * i + k] * cross[3 * k + j];
            out[4 * i + j] += sine * cross[3 * i + j] + across * square;
            along += (across * cross[3 * i + j] + (angle - sine) * square) * v[j];
        }
        out[4 * i + 3] = along / size;
    }
}

/* A twist as it is seen from a frame that it is given in. */
static void carry_twist(double *out, const double *frame, const double *twist)
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

/* A station's frame in its body, before its own motion, once the stations before it have moved. */
static void station_frame(double *out, Size station, Size bodies, const double *into, const double *origins,
                          const double *tool, const double *motions)
{
    const Size body = (station - 1) / 2;
    if (station == 0)
        invert(out, motions);
    else if (station == 2 * bodies + 1) {
        station_frame(out, station - 1, bodies, into, origins, tool, motions);
        follow(out, out, motions + 16 * (station - 1));
        follow(out, out, tool);
    } else if (station % 2)
        memcpy(out, into + 16 * body, 16 * sizeof(double));
    else {
        follow(out, into + 16 * body, motions + 16 * (station - 1));
        follow(out, out, origins + 16 * body);
    }
}

/* What errors x of twists (p, 6) make of the stations they are at, ascending, and the twists in the frames of
   the bodies that they move: one at a station turns with those before it. */
static void move(Size bodies, Size p, const double *into, const double *origins, const double *tool,
                 const Size *stations, const double *twists, const double *x, double *motions,
                 double *carried)
{
    for (Size i = 0; i < 2 * bodies + 2; i++)
        memcpy(motions + 16 * i, identity, sizeof identity);
    double step[16], frame[16];
    for (Size i = 0; i < p; i++) {
        exponential(step, twists + 6 * i, x[i]);
        follow(motions + 16 * stations[i], motions + 16 * stations[i], step);
    }
    for (Size i = 0; i < p; i++) {
        if (!i || stations[i] != stations[i - 1])
            station_frame(frame, stations[i], bodies, into, origins, tool, motions);
        carry_twist(carried + 6 * i, frame, twists + 6 * i);
        exponential(step, twists + 6 * i, x[i]);
        follow(frame, frame, step);
    }
}
