/* Breaks in one way after two samples: faulty WAY. */

#include "physx.h"

static physx_run run;
static double x = 1.0;
static unsigned char flag = 1;
static physx_array sample[] = {{"x", PHYSX_FLOAT64, 0, {0}, &x}, {"flag", PHYSX_BOOL, 0, {0}, &flag}};

static int is(const char *way, const char *other) { return !strcmp(way, other); }

static void put(const void *data, size_t size)
{
    if (write(run.socket, data, size) < 0) exit(9);
}

static int ask(const char *name, physx_type type, int rank, int64_t size)
{
    static char memory[1024];
    physx_array wanted[] = {{"", type, rank, {size}, memory}};
    strcpy(wanted[0].name, name);
    return physx_parameters(&run, wanted, 1);
}

static void describe(int rank, uint32_t type, const char *name)
{
    physx_header_ header = {{'p', 'h', 'y', 1}, PHYSX_SAMPLE_, 1, 8};
    physx_description_ description;
    memset(&description, 0, sizeof description);
    strcpy(description.name, name);
    description.type = type;
    description.rank = rank;
    description.shape[0] = -1;
    put(&header, sizeof header);
    put(&description, sizeof description);
    put("garbage", 8);
    pause();
}

static void send_two(int count)
{
    for (int i = 0; i < 2; i++)
        if (physx_send(&run, sample, count)) exit(8);
}

static void misbehave(const char *way)
{
    const physx_header_ header = {{'p', 'h', 'y', 1}, PHYSX_SAMPLE_, 1, 8};
    if (is(way, "abort")) abort();
    if (is(way, "exit")) exit(3);
    if (is(way, "leave")) exit(0);
    if (is(way, "hang")) pause();
    if (is(way, "hang with a child")) {
        if (fork() >= 0) pause();
    }
    if (is(way, "ignore")) {
        if (!system("trap '' TERM HUP INT; sleep 600")) exit(7);
    }
    if (is(way, "garbage")) put("there is nothing here that physx knows", 38);
    if (is(way, "version")) put("phy\2............", 16);
    if (is(way, "kind")) put("phy\1\77\0\0\0\0\0\0\0\0\0\0", 16);
    if (is(way, "huge")) put("phy\1\3\0\1\0\377\377\377\377\377\377\377\177", 16);
    if (is(way, "half")) put(&header, sizeof header);
    if (is(way, "half") || is(way, "quarter")) put("x", is(way, "half") ? 1 : 0);
    if (is(way, "type")) describe(0, 7, "x");
    if (is(way, "rank")) describe(99, PHYSX_FLOAT64, "x");
    if (is(way, "shape")) describe(1, PHYSX_FLOAT64, "x");
    if (is(way, "name")) describe(0, PHYSX_FLOAT64, "a b\n\033[31m");
    if (is(way, "reserved")) describe(0, PHYSX_FLOAT64, "step");
    if (is(way, "length")) describe(0, PHYSX_FLOAT32, "x");
    if (is(way, "twice")) {
        physx_array fields[] = {sample[0]};
        const physx_array *groups[2] = {fields, fields};
        const int counts[2] = {0, 1};
        physx_message_(&run, "test", PHYSX_FIELDS_, groups, counts);
    }
    if (is(way, "no inputs")) physx_predict(&run, sample, 0, sample, 1);
    if (is(way, "unknown parameter")) ask("alpah", PHYSX_FLOAT64, 0, 0);
    if (is(way, "parameter type")) ask("alpha", PHYSX_INT32, 0, 0);
    if (is(way, "parameter shape")) ask("alpha", PHYSX_FLOAT64, 1, 3);
    if (is(way, "flag")) flag = 77;
    if (is(way, "flag")) send_two(2);
    if (is(way, "status") || is(way, "stay")) physx_close(&run);
    if (is(way, "status")) exit(4);
    if (is(way, "too many")) exit(physx_send(&run, sample, 1000) == -1 ? 5 : 0);
    if (is(way, "no data")) sample[0].data = NULL;
    if (is(way, "no data")) exit(physx_send(&run, sample, 2) == -1 ? 5 : 0);
    pause();
}

int main(int argc, char **argv)
{
    const char *way = argc > 1 ? argv[1] : "";
    fprintf(stderr, "last words\n");
    if (is(way, "no open")) return 0;
    if (is(way, "never open")) pause();
    if (is(way, "nan")) x = 0.0 / (x - 1.0);
    if (physx_open(&run, sample, is(way, "no fields") ? 0 : 2)) return 6;
    if (is(way, "no sample")) return physx_close(&run);
    send_two(is(way, "missing") ? 1 : 2);
    misbehave(way);
    return 0;
}
