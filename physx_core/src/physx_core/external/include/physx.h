/* physx.h: sends the samples of a simulation in C99 or C++ to physx.

   Copy it, or compile with -I"$(physx include)":

       double u[N][N], t, alpha;
       physx_run run;
       physx_array sample[] = {{"u", PHYSX_FLOAT64, 2, {N, N}, u},
                               {"t", PHYSX_FLOAT64, 0, {0}, &t}};
       physx_array wanted[] = {{"alpha", PHYSX_FLOAT64, 0, {0}, &alpha}};

       if (physx_open(&run, sample, 2) || physx_parameters(&run, wanted, 1)) return 1;
       for (int step = 0; step < STEPS; step++) {
           ...                                   // simulate
           if (physx_send(&run, sample, 2)) return 1;
       }
       return physx_close(&run) ? 1 : 0;

   Each function returns 0, or -1 if the run is over or after a mistake, which is written to stderr;
   all later calls then return -1 as well. In an MPI program only one process calls them, unless each
   begins with physx_open_part; and only one thread at a time. For more, see docs/external.md of
   physx. */

#ifndef PHYSX_H
#define PHYSX_H

#include <errno.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/uio.h>
#include <sys/un.h>
#include <unistd.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef PHYSX_API
#define PHYSX_API static inline
#endif

#define PHYSX_ARRAYS 64 /* maximum number of arrays in one call */
#define PHYSX_RANK 8    /* maximum number of axes of an array */
#define PHYSX_NAME 52   /* maximum length of a name, including the terminating zero */
#define PHYSX_OPEN (-1) /* rank of a field whose shape is taken from the first sample */
#define PHYSX_LARGEST_ ((int64_t)1 << 31) /* bytes; the product of two does not overflow */

/* Type of the numbers of an array: NumPy's letter for their kind, and their size in bytes. */
typedef enum {
    PHYSX_BOOL = 'b' * 256 + 1,
    PHYSX_INT8 = 'i' * 256 + 1,
    PHYSX_INT16 = 'i' * 256 + 2,
    PHYSX_INT32 = 'i' * 256 + 4,
    PHYSX_INT64 = 'i' * 256 + 8,
    PHYSX_UINT8 = 'u' * 256 + 1,
    PHYSX_UINT16 = 'u' * 256 + 2,
    PHYSX_UINT32 = 'u' * 256 + 4,
    PHYSX_UINT64 = 'u' * 256 + 8,
    PHYSX_FLOAT32 = 'f' * 256 + 4,
    PHYSX_FLOAT64 = 'f' * 256 + 8,
    PHYSX_COMPLEX64 = 'c' * 256 + 8,
    PHYSX_COMPLEX128 = 'c' * 256 + 16
} physx_type;

/* A named array in the program's memory: contiguous, last axis fastest. A number has rank 0. */
typedef struct {
    char name[PHYSX_NAME];
    physx_type type;
    int rank;
    int64_t shape[PHYSX_RANK];
    void *data;
} physx_array;

/* The connection to the run. */
typedef struct {
    int socket;
} physx_run;

/* Connect to the run that started this program, and declare the fields of a sample. */
PHYSX_API int physx_open(physx_run *run, const physx_array *fields, int count);

/* As physx_open, in each of several processes that send parts of each sample. All of them make the
   same calls in the same order then. A field that several declare is divided along its first axis:
   the part of this process begins at its offset in the whole field. The others are whole. */
PHYSX_API int physx_open_part(physx_run *run, int rank, int ranks, const physx_array *fields,
                              const int64_t *offsets, int count);

/* Receive parameters, by name, into the arrays. A call after a sample begins a new episode, and
   waits until it is due. */
PHYSX_API int physx_parameters(physx_run *run, const physx_array *wanted, int count);

/* Send a sample: all fields. It is one step of the environment. */
PHYSX_API int physx_send(physx_run *run, const physx_array *sample, int count);

/* Receive the network's prediction for the inputs into the outputs. Both have the names of its
   fields. */
PHYSX_API int physx_predict(physx_run *run, const physx_array *inputs, int input_count,
                            const physx_array *outputs, int output_count);

/* Report that the program has sent all its samples, and disconnect. A program that ends without
   this call has failed. */
PHYSX_API int physx_close(physx_run *run);

/* Internals, not for use by programs. -------------------------------------------------------- */

enum {
    PHYSX_FIELDS_ = 1,
    PHYSX_PARAMETERS_ = 2,
    PHYSX_SAMPLE_ = 3,
    PHYSX_PREDICT_ = 4,
    PHYSX_CLOSE_ = 5,
    PHYSX_ANSWER_ = 6,
    PHYSX_PART_ = 7
};

static const char physx_magic_[4] = {'p', 'h', 'y', 1}; /* last byte: the protocol's version */

typedef struct {
    char magic[4];
    uint16_t kind, count; /* kind of message; number of arrays that it describes */
    uint64_t size;        /* in bytes, of the data after the descriptions */
} physx_header_;

typedef struct {
    char name[PHYSX_NAME];
    uint32_t type;
    int32_t rank;
    uint32_t wanted; /* 1: requested, its data does not follow */
    int64_t shape[PHYSX_RANK];
} physx_description_;

typedef char physx_header_has_16_bytes_[sizeof(physx_header_) == 16 ? 1 : -1];
typedef char physx_description_has_128_bytes_[sizeof(physx_description_) == 128 ? 1 : -1];

static inline int physx_end_(physx_run *run)
{
    if (run->socket >= 0) close(run->socket);
    run->socket = -1;
    return -1;
}

static inline int physx_mistake_(physx_run *run, const char *call, const char *name,
                                 const char *text)
{
    fprintf(stderr, "physx: %s: %s%s%s\n", call, name, *name ? ": " : "", text);
    fflush(stderr);
    return physx_end_(run);
}

/* Return the size of an array in bytes, or -1 and the mistake in its description. */
static inline int64_t physx_size_(const physx_array *array, const char **mistake)
{
    int64_t size = (int64_t)((unsigned)array->type & 255u);
    int axis;
    *mistake = NULL;
    if (!memchr(array->name, 0, PHYSX_NAME) || !array->name[0])
        *mistake = "names have 1 to 51 characters";
    else if (size == 0) *mistake = "it has no type";
    else if (array->rank < 0 || array->rank > PHYSX_RANK) *mistake = "its rank must be from 0 to 8";
    for (axis = 0; !*mistake && axis < array->rank; axis++) {
        if (array->shape[axis] < 0) *mistake = "its shape is negative";
        else if (array->shape[axis] > PHYSX_LARGEST_) *mistake = "it is too large";
        else if ((size *= array->shape[axis]) > PHYSX_LARGEST_) *mistake = "it is too large";
    }
    if (!*mistake && size && !array->data) *mistake = "it has no data";
    return *mistake ? -1 : size;
}

static inline int physx_write_(physx_run *run, struct iovec *parts, int count)
{
    while (count) {
        struct msghdr message;
        ssize_t sent;
        memset(&message, 0, sizeof message);
        message.msg_iov = parts;
        message.msg_iovlen = (size_t)count;
        sent = sendmsg(run->socket, &message, MSG_NOSIGNAL);
        if (sent < 0 && errno == EINTR) continue;
        if (sent < 0) return physx_end_(run); /* the run is over */
        while (count && (size_t)sent >= parts->iov_len) {
            sent -= (ssize_t)parts->iov_len;
            parts++;
            count--;
        }
        if (count) {
            parts->iov_base = (char *)parts->iov_base + sent;
            parts->iov_len -= (size_t)sent;
        }
    }
    return 0;
}

static inline int physx_read_(physx_run *run, void *data, size_t size)
{
    char *to = (char *)data;
    while (size) {
        ssize_t got = recv(run->socket, to, size, 0);
        if (got < 0 && errno == EINTR) continue;
        if (got <= 0) return physx_end_(run); /* the run is over */
        to += got;
        size -= (size_t)got;
    }
    return 0;
}

/* Send a message with the arrays of the first group and descriptions of those of the second, and
   receive the data of the second if it is a request. */
static inline int physx_message_(physx_run *run, const char *call, int kind,
                                 const physx_array *const groups[2], const int counts[2])
{
    physx_description_ descriptions[PHYSX_ARRAYS];
    struct iovec parts[PHYSX_ARRAYS + 2];
    physx_header_ header, answer;
    int64_t sizes[PHYSX_ARRAYS], asked = 0;
    int count = 0, part = 2, group, index, axis;

    if (run->socket < 0) return -1;
    if (counts[0] < 0 || counts[1] < 0 || counts[0] > PHYSX_ARRAYS ||
        counts[1] > PHYSX_ARRAYS - counts[0])
        return physx_mistake_(run, call, "", "it takes 0 to 64 arrays");
    memset(&header, 0, sizeof header);
    memset(descriptions, 0, sizeof descriptions);
    for (group = 0; group < 2; group++) {
        for (index = 0; index < counts[group]; index++, count++) {
            physx_array array = groups[group][index];
            physx_description_ *description = &descriptions[count];
            const char *mistake;
            description->rank = array.rank;
            if (kind == PHYSX_FIELDS_) { /* only described */
                static char nowhere;
                array.data = &nowhere;
                if (array.rank == PHYSX_OPEN) array.rank = 0;
            }
            sizes[count] = physx_size_(&array, &mistake);
            if (mistake) {
                array.name[PHYSX_NAME - 1] = 0;
                return physx_mistake_(run, call, array.name, mistake);
            }
            memcpy(description->name, array.name, strlen(array.name));
            description->type = (uint32_t)array.type;
            description->wanted = (uint32_t)group;
            for (axis = 0; axis < array.rank; axis++) description->shape[axis] = array.shape[axis];
            if (group) {
                asked += sizes[count];
            } else {
                parts[part].iov_base = array.data;
                parts[part++].iov_len = (size_t)sizes[count];
                header.size += (uint64_t)sizes[count];
            }
        }
    }
    memcpy(header.magic, physx_magic_, sizeof header.magic);
    header.kind = (uint16_t)kind;
    header.count = (uint16_t)count;
    parts[0].iov_base = &header;
    parts[0].iov_len = sizeof header;
    parts[1].iov_base = descriptions;
    parts[1].iov_len = (size_t)count * sizeof descriptions[0];
    if (physx_write_(run, parts, part)) return -1;
    if (kind != PHYSX_PARAMETERS_ && kind != PHYSX_PREDICT_) return 0;

    if (physx_read_(run, &answer, sizeof answer)) return -1;
    if (memcmp(answer.magic, physx_magic_, sizeof answer.magic) || answer.kind != PHYSX_ANSWER_ ||
        answer.size != (uint64_t)asked)
        return physx_mistake_(run, call, "", "the answer does not match the request");
    for (index = 0; index < counts[1]; index++)
        if (physx_read_(run, groups[1][index].data, (size_t)sizes[counts[0] + index]))
            return -1;
    return 0;
}

/* Connect to the run that started this program. */
static inline int physx_connect_(physx_run *run, const char *call)
{
    const char *path = getenv("PHYSX_SOCKET");
    const uint16_t one = 1;
    struct sockaddr_un address;

    run->socket = -1;
    if (!path)
        return physx_mistake_(run, call, "PHYSX_SOCKET is not set",
                              "this program was not started by a physx run");
    memset(&address, 0, sizeof address);
    address.sun_family = AF_UNIX;
    if (!*(const unsigned char *)&one || strlen(path) >= sizeof address.sun_path)
        return physx_mistake_(run, call, path,
                              "the path is too long, or this machine is big-endian");
    memcpy(address.sun_path, path, strlen(path));
    run->socket = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (run->socket < 0 || connect(run->socket, (const struct sockaddr *)&address, sizeof address))
        return physx_mistake_(run, call, strerror(errno),
                              "the run is over, or this program has already called it (of an MPI "
                              "program one process may, or each calls physx_open_part)");
    return 0;
}

PHYSX_API int physx_open(physx_run *run, const physx_array *fields, int count)
{
    const physx_array *groups[2];
    int counts[2];
    groups[0] = groups[1] = fields;
    counts[0] = 0;
    counts[1] = count;
    if (physx_connect_(run, "physx_open")) return -1;
    return physx_message_(run, "physx_open", PHYSX_FIELDS_, groups, counts);
}

PHYSX_API int physx_open_part(physx_run *run, int rank, int ranks, const physx_array *fields,
                              const int64_t *offsets, int count)
{
    int64_t part[PHYSX_ARRAYS + 2];
    physx_array array;
    const physx_array *groups[2];
    int counts[2] = {1, 0};
    int index;
    if (physx_connect_(run, "physx_open_part")) return -1;
    if (count < 0 || count > PHYSX_ARRAYS)
        return physx_mistake_(run, "physx_open_part", "", "it takes 0 to 64 arrays");
    part[0] = rank;
    part[1] = ranks;
    for (index = 0; index < count; index++) part[index + 2] = offsets[index];
    memset(&array, 0, sizeof array);
    memcpy(array.name, "part", 5);
    array.type = PHYSX_INT64;
    array.rank = 1;
    array.shape[0] = count + 2;
    array.data = part;
    groups[0] = groups[1] = &array;
    if (physx_message_(run, "physx_open_part", PHYSX_PART_, groups, counts)) return -1;
    groups[1] = fields;
    counts[0] = 0;
    counts[1] = count;
    return physx_message_(run, "physx_open_part", PHYSX_FIELDS_, groups, counts);
}

PHYSX_API int physx_parameters(physx_run *run, const physx_array *wanted, int count)
{
    const physx_array *groups[2];
    int counts[2];
    groups[0] = groups[1] = wanted;
    counts[0] = 0;
    counts[1] = count;
    return physx_message_(run, "physx_parameters", PHYSX_PARAMETERS_, groups, counts);
}

PHYSX_API int physx_send(physx_run *run, const physx_array *sample, int count)
{
    const physx_array *groups[2];
    int counts[2];
    groups[0] = groups[1] = sample;
    counts[0] = count;
    counts[1] = 0;
    return physx_message_(run, "physx_send", PHYSX_SAMPLE_, groups, counts);
}

PHYSX_API int physx_predict(physx_run *run, const physx_array *inputs, int input_count,
                            const physx_array *outputs, int output_count)
{
    const physx_array *groups[2];
    int counts[2];
    groups[0] = inputs;
    groups[1] = outputs;
    counts[0] = input_count;
    counts[1] = output_count;
    return physx_message_(run, "physx_predict", PHYSX_PREDICT_, groups, counts);
}

PHYSX_API int physx_close(physx_run *run)
{
    const physx_array *groups[2] = {NULL, NULL};
    const int counts[2] = {0, 0};
    int status = physx_message_(run, "physx_close", PHYSX_CLOSE_, groups, counts);
    physx_end_(run);
    return status;
}

#ifdef __cplusplus
}
#endif

#endif
