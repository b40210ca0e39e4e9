/* The inner loops of `kinematics` and `reduction`, compiled: the same sums over many samples at once.

   Arrays are of doubles and components first, as in those modules: samples are contiguous. */

#define Py_LIMITED_API 0x030b0000
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <stdlib.h>

#include "samples.h"
#include "frames.h"
#include "jacobian.h"
#include "qr.h"

/* What a function takes: an array's name, number of axes, and type: d double, s size, ? truth, D doubles that
   are written. */
typedef struct {
    const char *name;
    int axes;
    char type;
} Wanted;

/* An array with its last axis contiguous, its strides in items. */
typedef struct {
    Py_buffer view;
    void *data;
    Size stride[4];
} Array;

static void release(Array *a, Size count)
{
    while (count--)
        PyBuffer_Release(&a[count].view);
}

static int take(Array *a, PyObject *from, Wanted wanted)
{
    const int written = wanted.type == 'D';
    if (PyObject_GetBuffer(from, &a->view, PyBUF_STRIDES | PyBUF_FORMAT | (written ? PyBUF_WRITABLE : 0)) < 0)
        return 0;
    const Py_buffer *v = &a->view;
    const char *format = v->format ? v->format : "";
    const char *right = wanted.type == '?' ? "?" : wanted.type == 's' ? "lqn" : "d";
    const Size size = wanted.type == '?' ? 1 : 8;
    int fine = v->ndim == wanted.axes && v->itemsize == size && *format && strchr(right, *format);
    for (int i = 0; fine && i < v->ndim; i++) {
        a->stride[i] = v->strides[i] / size;
        fine = v->strides[i] % size == 0 && (i < v->ndim - 1 || a->stride[i] == 1 || v->shape[i] < 2);
    }
    a->data = v->buf;
    if (!fine) {
        PyErr_Format(PyExc_ValueError, "%s: wants %d axes of %s, the last one contiguous", wanted.name,
                     wanted.axes, right);
        PyBuffer_Release(&a->view);
    }
    return fine;
}

/* Takes all arguments, or none and sets the error. */
static int take_all(Array *a, PyObject *args, const Wanted *wanted, Size count)
{
    if (PyTuple_Size(args) != count) {
        PyErr_Format(PyExc_TypeError, "takes %zd arrays", count);
        return 0;
    }
    for (Size i = 0; i < count; i++)
        if (!take(a + i, PyTuple_GetItem(args, i), wanted[i])) {
            release(a, i);
            return 0;
        }
    return 1;
}

static int is_shaped(const Array *a, Size first, Size second, Size third, Size fourth)
{
    const Size shape[] = {first, second, third, fourth};
    for (int i = 0; i < a->view.ndim; i++)
        if (a->view.shape[i] != shape[i])
            return 0;
    return 1;
}

/* Whether all axes are contiguous. */
static int is_packed(const Array *a)
{
    Size step = 1;
    for (int i = a->view.ndim; i--; step *= a->view.shape[i])
        if (a->stride[i] != step && a->view.shape[i] > 1)
            return 0;
    return 1;
}

static PyObject *answer(Array *a, Size count, int fine)
{
    release(a, count);
    if (fine)
        Py_RETURN_NONE;
    if (!PyErr_Occurred())
        PyErr_SetString(PyExc_ValueError, "the arrays' shapes do not go together");
    return NULL;
}

static PyObject *cos_sin(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"angles", 2, 'd'}, {"cosines", 2, 'D'}, {"sines", 2, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Size k = a->view.shape[0], m = a->view.shape[1];
    int fine = is_packed(a);
    for (int i = 1; i < 3; i++)
        fine = fine && is_shaped(a + i, k, m, 0, 0) && is_packed(a + i);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        circle(k * m, a->data, a[1].data, a[2].data);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 3, fine);
}

static PyObject *propagate_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"links", 3, 'd'}, {"prismatic", 1, '?'}, {"values", 2, 'd'},
                                    {"cos", 2, 'd'},   {"sin", 2, 'd'},       {"frames", 4, 'D'}};
    Array a[6];
    if (!take_all(a, args, wanted, 6))
        return NULL;
    const Array *links = a, *values = a + 2, *frames = a + 5;
    const Size k = values->view.shape[0], m = values->view.shape[1];
    int fine = is_shaped(links, k + 1, 4, 4, 0) && is_shaped(a + 1, k, 0, 0, 0) &&
               is_shaped(a + 3, k, m, 0, 0) && is_shaped(a + 4, k, m, 0, 0) &&
               is_shaped(frames, k + 2, frames->view.shape[1], 3, m) && frames->view.shape[1] >= 4 &&
               frames->stride[1] == 3 * frames->stride[2];
    for (int i = 0; i < 5; i++)
        fine = fine && is_packed(a + i);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        carry(k + 1, m, links->data, a[1].data, values->data, a[3].data, a[4].data, frames->data,
              frames->stride[0], frames->stride[2]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 6, fine);
}

/* Errors from frames (b, r, 3, n), a point (3, n), bodies (p) and twists (p, 6), or those of members (b, p,
 * 6). */
static int errors_of(Errors *e, const Array *a)
{
    const Array *frames = a, *point = a + 1, *at = a + 2, *twists = a + 3;
    const Size p = at->view.shape[0], n = point->view.shape[1];
    int fine = is_shaped(frames, frames->view.shape[0], frames->view.shape[1], 3, n) &&
               frames->view.shape[1] >= 4 && frames->stride[1] == 3 * frames->stride[2] &&
               is_shaped(point, 3, n, 0, 0) && is_packed(twists);
    fine = fine && (twists->view.ndim == 2 ? is_shaped(twists, p, 6, 0, 0)
                                           : is_shaped(twists, twists->view.shape[0], p, 6, 0));
    const Size *bodies = at->data;
    for (Size i = 0; fine && i < p; i++)
        fine = bodies[i] >= 0 && bodies[i] < frames->view.shape[0];
    *e = (Errors){.count = p,
                  .ends = 1,
                  .apart = n,
                  .at = bodies,
                  .twists = twists->data,
                  .frames = frames->data,
                  .body = frames->stride[0],
                  .row = frames->stride[2],
                  .point = point->data,
                  .point_row = point->stride[0]};
    return fine;
}

/* Mixture from rows (n), components (n) and shares (n, m), for k rows and a number of ends. */
static int mixture_of(Mixture *x, const Array *a, Size k, Size ends, Size m)
{
    const Array *rows = a, *components = a + 1, *shares = a + 2;
    const Size n = rows->view.shape[0], *row = rows->data, *component = components->data;
    int fine = is_shaped(components, n, 0, 0, 0) && is_shaped(shares, n, m, 0, 0);
    for (Size i = 0; fine && i < n; i++)
        fine = row[i] >= 0 && row[i] < k && component[i] >= 0 && component[i] < 6 * ends &&
               (!i || row[i] >= row[i - 1]);
    *x = (Mixture){.count = n,
                   .rows = row,
                   .components = component,
                   .shares = shares->data,
                   .stride = shares->stride[0]};
    return fine;
}

static PyObject *point_jacobian(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {
        {"frames", 4, 'd'}, {"point", 2, 'd'}, {"at", 1, 's'}, {"twists", 2, 'd'}, {"out", 3, 'D'}};
    Array a[5];
    if (!take_all(a, args, wanted, 5))
        return NULL;
    const Array *out = a + 4;
    const Size m = a[1].view.shape[1];
    Errors errors;
    const int fine = errors_of(&errors, a) && is_shaped(out, errors.count, 6, m, 0);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        velocities(&errors, m, out->data, out->stride[0], out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 5, fine);
}

static PyObject *apply_observation_matrix(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"velocities", 3, 'd'},
                                    {"rows", 1, 's'},
                                    {"components", 1, 's'},
                                    {"shares", 2, 'd'},
                                    {"out", 3, 'D'}};
    Array a[5];
    if (!take_all(a, args, wanted, 5))
        return NULL;
    const Array *given = a, *out = a + 4;
    const Size p = out->view.shape[0], k = out->view.shape[1], m = out->view.shape[2];
    const Size ends = m ? given->view.shape[2] / m : 1;
    Mixture mixture;
    const int fine = is_shaped(given, p, 6, ends * m, 0) && mixture_of(&mixture, a + 1, k, ends, m);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        mix(&mixture, p, k, m, given->data, given->stride[0], given->stride[1], out->data, out->stride[0],
            out->stride[1]);
        Py_END_ALLOW_THREADS;
    }
    return answer(a, 5, fine);
}

static PyObject *perturb_frames(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"into", 3, 'd'},     {"origins", 3, 'd'}, {"tool", 2, 'd'},
                                    {"stations", 1, 's'}, {"twists", 2, 'd'},  {"x", 1, 'd'},
                                    {"motions", 3, 'D'},  {"carried", 2, 'D'}};
    Array a[8];
    if (!take_all(a, args, wanted, 8))
        return NULL;
    const Size b = a->view.shape[0], p = a[3].view.shape[0], *stations = a[3].data;
    int fine = is_shaped(a, b, 4, 4, 0) && is_shaped(a + 1, b, 4, 4, 0) && is_shaped(a + 2, 4, 4, 0, 0) &&
               is_shaped(a + 4, p, 6, 0, 0) && is_shaped(a + 5, p, 0, 0, 0) &&
               is_shaped(a + 6, 2 * b + 2, 4, 4, 0) && is_shaped(a + 7, p, 6, 0, 0);
    for (int i = 0; i < 8; i++)
        fine = fine && is_packed(a + i);
    for (Size i = 0; fine && i < p; i++)
        fine = stations[i] >= (i ? stations[i - 1] : 0) && stations[i] < 2 * b + 2;
    if (fine)
        move(b, p, a->data, a[1].data, a[2].data, stations, a[4].data, a[5].data, a[6].data, a[7].data);
    return answer(a, 8, fine);
}

static PyObject *log_rotations(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"turns", 3, 'd'}, {"out", 2, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[2];
    if (!is_shaped(a, 3, 3, m, 0) || !is_shaped(a + 1, 3, m, 0, 0))
        return answer(a, 2, 0);
    const Size obtuse = rotation_vectors(m, a->data, a->stride[0], a->stride[1], a[1].data, a[1].stride[0]);
    release(a, 2);
    return PyLong_FromSsize_t(obtuse);
}

static PyObject *right_jacobian_inverse_batch(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"vectors", 2, 'd'}, {"out", 3, 'D'}};
    Array a[2];
    if (!take_all(a, args, wanted, 2))
        return NULL;
    const Size m = a->view.shape[1];
    const int fine = is_shaped(a, 3, m, 0, 0) && is_shaped(a + 1, 3, 3, m, 0);
    if (fine)
        jacobian_inverses(m, a->data, a->stride[0], a[1].data, a[1].stride[0], a[1].stride[1]);
    return answer(a, 2, fine);
}

/* Doubles that a triangle of so many columns, readings and ends is worked out in. */
static PyObject *room(PyObject *self, PyObject *args)
{
    (void)self;
    Size c, k, ends;
    return PyArg_ParseTuple(args, "nnn", &c, &k, &ends) ? PyLong_FromSsize_t(room_for(c, k, ends)) : NULL;
}

static PyObject *triangles(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {{"rows", 4, 'd'}, {"room", 1, 'D'}, {"out", 3, 'D'}};
    Array a[3];
    if (!take_all(a, args, wanted, 3))
        return NULL;
    const Array *rows = a, *out = a + 2;
    const Size b = rows->view.shape[0], c = rows->view.shape[1];
    const Size k = rows->view.shape[2], m = rows->view.shape[3];
    int fine = is_shaped(out, b, c, c, 0) && is_packed(out) && a[1].view.shape[0] >= room_for(c, k, 0);
    if (fine) {
        static const Errors none = {0};
        static const Mixture nothing = {0};
        Py_BEGIN_ALLOW_THREADS;
        for (Size i = 0; fine && i < b; i++)
            fine = reduce(&none, &nothing, (double *)rows->data + i * rows->stride[0], c, k, m,
                          rows->stride[1], rows->stride[2], (double *)out->data + i * c * c, a[1].data);
        Py_END_ALLOW_THREADS;
        if (!fine)
            PyErr_NoMemory();
    }
    return answer(a, 3, fine);
}

static PyObject *factor_jacobian(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {
        {"frames", 4, 'd'},     {"point", 2, 'd'},  {"at", 1, 's'},    {"twists", 3, 'd'}, {"rows", 1, 's'},
        {"components", 1, 's'}, {"shares", 2, 'd'}, {"given", 3, 'd'}, {"room", 1, 'D'},   {"out", 3, 'D'}};
    Array a[10];
    if (!take_all(a, args, wanted, 10))
        return NULL;
    const Array *given = a + 7, *room = a + 8, *out = a + 9;
    const Size b = a[3].view.shape[0], k = given->view.shape[1], n = given->view.shape[2],
               samples = a[1].view.shape[1];
    Errors all;
    Mixture mixture;
    int fine = errors_of(&all, a);
    const Size c = all.count + given->view.shape[0], m = b ? n / b : 0;
    all.ends = n ? samples / n : 1, all.apart = n;
    fine = fine && m * b == n && all.ends * n == samples && mixture_of(&mixture, a + 4, k, all.ends, n) &&
           is_shaped(out, b, c, c, 0) && is_packed(out) && room->view.shape[0] >= room_for(c, k, all.ends);
    if (fine) {
        Py_BEGIN_ALLOW_THREADS;
        for (Size i = 0; fine && i < b; i++) {
            /* The samples of members follow each other. */
            Errors errors = all;
            Mixture shares = mixture;
            errors.frames += i * m, errors.point += i * m, errors.twists += i * 6 * all.count,
                shares.shares += i * m;
            fine = reduce(&errors, &shares, (double *)given->data + i * m, c, k, m, given->stride[0],
                          given->stride[1], (double *)out->data + i * c * c, room->data);
        }
        Py_END_ALLOW_THREADS;
        if (!fine)
            PyErr_NoMemory();
    }
    return answer(a, 10, fine);
}

static PyObject *append_diagonal(PyObject *self, PyObject *args)
{
    (void)self;
    static const Wanted wanted[] = {
        {"triangle", 2, 'd'}, {"diagonal", 1, 'd'}, {"right", 1, 'd'}, {"room", 1, 'D'}, {"out", 2, 'D'}};
    Array a[5];
    if (!take_all(a, args, wanted, 5))
        return NULL;
    const Size p = a[1].view.shape[0];
    const int fine = is_shaped(a, p + 1, p + 1, 0, 0) && is_packed(a) && is_shaped(a + 2, p, 0, 0, 0) &&
                     a[3].view.shape[0] >= room_for(p + 1, 1, 0) && is_shaped(a + 4, p + 1, p + 1, 0, 0) &&
                     is_packed(a + 4);
    if (fine)
        add_diagonal(a->data, p, a[1].data, a[2].data, a[4].data, a[3].data);
    return answer(a, 5, fine);
}

static PyMethodDef methods[] = {
    {"cos_sin", cos_sin, METH_VARARGS, NULL},
    {"propagate_frames", propagate_frames, METH_VARARGS, NULL},
    {"point_jacobian", point_jacobian, METH_VARARGS, NULL},
    {"apply_observation_matrix", apply_observation_matrix, METH_VARARGS, NULL},
    {"perturb_frames", perturb_frames, METH_VARARGS, NULL},
    {"log_rotations", log_rotations, METH_VARARGS, NULL},
    {"right_jacobian_inverse_batch", right_jacobian_inverse_batch, METH_VARARGS, NULL},
    {"work_size", room, METH_VARARGS, NULL},
    {"r_factors", triangles, METH_VARARGS, NULL},
    {"factor_jacobian", factor_jacobian, METH_VARARGS, NULL},
    {"append_diagonal", append_diagonal, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static PyModuleDef_Slot slots[] = {{0, NULL}};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, .m_name = "_native", .m_size = 0,
                                    .m_methods = methods, .m_slots = slots};

PyMODINIT_FUNC PyInit__native(void)
{
    return PyModuleDef_Init(&module);
}
